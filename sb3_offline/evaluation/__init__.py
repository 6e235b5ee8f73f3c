"""Judging what was learned without an environment: callbacks and functions over held-out data."""

from sb3_offline.evaluation.callbacks import OfflineEvalCallback
from sb3_offline.evaluation.fitted_q import fitted_q_evaluation

__all__ = ["OfflineEvalCallback", "fitted_q_evaluation"]
