"""The loss of the classifier as a plain function of logits."""

import torch as th
from torch.nn import functional as F


def positive_unlabelled_loss(example_logits: th.Tensor, data_logits: th.Tensor, positive_share: float = 0.0) -> th.Tensor:
    """
    Cross-entropy of examples (label 1) and of the data's failures (label 0), where the data hold successes that look like the
    examples: a share eta of them. Its estimate of the failures' part is non-negative
    (nnPU, https://arxiv.org/abs/1703.00593)::

        CE(f_E; 1) + |CE(f_U; 0) - eta CE(f_E; 0)| / (1 - eta)

    :param example_logits: logits of success examples, f_E, ``(n_examples,)``
    :param data_logits: logits of the dataset's observations, f_U, ``(batch,)``
    :param positive_share: eta, below 1; 0 takes all data for failures
    :return: scalar
    """
    positives, negatives = F.softplus(-example_logits).mean(), F.softplus(data_logits).mean()
    if positive_share > 0:
        # Below zero, the network has learned the examples by heart. The absolute value then takes a step back, as in the paper
        negatives = (negatives - positive_share * F.softplus(example_logits).mean()).abs() / (1 - positive_share)
    return positives + negatives
