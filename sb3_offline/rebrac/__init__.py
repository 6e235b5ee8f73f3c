from sb3_offline.rebrac.policies import CnnPolicy, MlpPolicy, MultiInputPolicy
from sb3_offline.rebrac.rebrac import ReBRAC

__all__ = ["CnnPolicy", "MlpPolicy", "MultiInputPolicy", "ReBRAC"]
