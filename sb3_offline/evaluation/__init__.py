"""Evaluation without an environment, on held-out data: callbacks and functions."""

from sb3_offline.evaluation.callbacks import OfflineEvalCallback
from sb3_offline.evaluation.fitted_q import fitted_q_evaluation

__all__ = ["OfflineEvalCallback", "fitted_q_evaluation"]
