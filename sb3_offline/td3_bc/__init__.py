from sb3_offline.td3_bc.policies import CnnPolicy, MlpPolicy, MultiInputPolicy
from sb3_offline.td3_bc.td3_bc import TD3BC

__all__ = ["TD3BC", "CnnPolicy", "MlpPolicy", "MultiInputPolicy"]
