from sb3_offline.iql.iql import IQL
from sb3_offline.iql.policies import CnnPolicy, MlpPolicy, MultiInputPolicy

__all__ = ["IQL", "CnnPolicy", "MlpPolicy", "MultiInputPolicy"]
