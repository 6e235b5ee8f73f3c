from sb3_offline.cql.cql import CQL
from sb3_offline.cql.policies import CnnPolicy, MlpPolicy, MultiInputPolicy

__all__ = ["CQL", "CnnPolicy", "MlpPolicy", "MultiInputPolicy"]
