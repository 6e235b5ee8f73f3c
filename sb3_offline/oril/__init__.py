from sb3_offline.oril.oril import ORIL
from sb3_offline.oril.policies import CnnPolicy, MlpPolicy, MultiInputPolicy

__all__ = ["ORIL", "CnnPolicy", "MlpPolicy", "MultiInputPolicy"]
