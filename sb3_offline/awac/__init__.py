from sb3_offline.awac.awac import AWAC
from sb3_offline.awac.policies import CnnPolicy, MlpPolicy, MultiInputPolicy

__all__ = ["AWAC", "CnnPolicy", "MlpPolicy", "MultiInputPolicy"]
