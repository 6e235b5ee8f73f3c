"""Success labels from examples of success: which observations show the solved task, and which episodes solve it."""

from sb3_offline.labelling.classifier import ClassifierSettings, StepProbabilities, success_probabilities
from sb3_offline.labelling.episodes import EpisodeLabels, Estimate, LabelCheck, check_labels, label_episodes
from sb3_offline.labelling.selection import select_detected
from sb3_offline.labelling.side_file import load_labels, save_labels, write_labelled_copy

__all__ = [
    "ClassifierSettings",
    "EpisodeLabels",
    "Estimate",
    "LabelCheck",
    "StepProbabilities",
    "check_labels",
    "label_episodes",
    "load_labels",
    "save_labels",
    "select_detected",
    "success_probabilities",
    "write_labelled_copy",
]
