"""The loss of ORIL's reward model as a plain function of logits."""

import torch as th
from torch.nn import functional as F


def classifier_loss(example_logits: th.Tensor, data_logits: th.Tensor, positive_prior: float | None = None) -> th.Tensor:
    """
    Cross-entropy of examples (label 1) and observations of the dataset (label 0).

    The dataset also contains successes. With ``positive_prior`` eta it is treated as a mixture in which a share eta looks like
    the examples: ``eta CE(f_E; 1) + CE(f_U; 0) - eta CE(f_E; 0)``.

    :param example_logits: logits of success examples, f_E, ``(n_examples,)``
    :param data_logits: logits of the dataset's observations, f_U, ``(batch,)``
    :param positive_prior: eta; ``None`` for the plain cross-entropy
    :return: scalar
    """
    positives, negatives = F.softplus(-example_logits).mean(), F.softplus(data_logits).mean()
    if positive_prior is None:
        return positives + negatives
    return positive_prior * positives + negatives - positive_prior * F.softplus(example_logits).mean()
