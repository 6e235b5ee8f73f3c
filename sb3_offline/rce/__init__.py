from sb3_offline.ceborl.policies import CnnPolicy, MlpPolicy, MultiInputPolicy
from sb3_offline.rce.rce import RCE

__all__ = ["RCE", "CnnPolicy", "MlpPolicy", "MultiInputPolicy"]
