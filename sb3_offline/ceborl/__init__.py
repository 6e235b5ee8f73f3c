from sb3_offline.ceborl.ceborl import CEBORL, PAPER_FORM
from sb3_offline.ceborl.diagnostics import DiagnosticsCallback
from sb3_offline.ceborl.policies import CnnPolicy, MlpPolicy, MultiInputPolicy

__all__ = ["CEBORL", "PAPER_FORM", "CnnPolicy", "DiagnosticsCallback", "MlpPolicy", "MultiInputPolicy"]
