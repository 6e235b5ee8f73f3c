"""The conservative term of CQL as a plain function of values. It knows no network, optimizer or dataset."""

import torch as th


def conservative_gaps(data_values: th.Tensor, sampled_values: th.Tensor, log_densities: th.Tensor) -> th.Tensor:
    """
    ``E_D[log sum_k exp(Q_i(s, a_k)) / p(a_k) - Q_i(s, a)]``: how far sampled actions are valued above the data's.

    The sum is an importance-weighted estimate of ``integral exp(Q_i(s, a)) da``, up to the number of samples, which it is
    not divided by: that adds a constant, as in the authors' code.

    :param data_values: of dataset actions, ``(n_critics, batch)``
    :param sampled_values: of sampled actions, ``(n_critics, batch, n_samples)``
    :param log_densities: log p(a_k) of these actions under the distribution that each was drawn from, ``(batch, n_samples)``
    :return: of each critic, ``(n_critics,)``
    """
    return (th.logsumexp(sampled_values - log_densities, dim=2) - data_values).mean(dim=1)
