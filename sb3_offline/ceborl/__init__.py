from sb3_offline.ceborl.ceborl import CEBORL
from sb3_offline.ceborl.policies import CnnPolicy, MlpPolicy, MultiInputPolicy

__all__ = ["CEBORL", "CnnPolicy", "MlpPolicy", "MultiInputPolicy"]
