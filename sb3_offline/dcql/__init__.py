from sb3_offline.dcql.dcql import DCQL
from sb3_offline.dcql.policies import CnnPolicy, MlpPolicy, MultiInputPolicy

__all__ = ["DCQL", "CnnPolicy", "MlpPolicy", "MultiInputPolicy"]
