from sb3_offline.bc.bc import BC
from sb3_offline.bc.policies import CnnPolicy, MlpPolicy, MultiInputPolicy

__all__ = ["BC", "CnnPolicy", "MlpPolicy", "MultiInputPolicy"]
