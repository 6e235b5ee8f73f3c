"""Fitted Q evaluation: the value of a policy, from data alone."""

from itertools import chain
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.common.vec_env import VecNormalize

from sb3_offline.common.losses import bellman_loss
from sb3_offline.common.offline_algorithm import OfflineAlgorithm
from sb3_offline.common.policies import OfflineCritic, OfflinePolicy
from sb3_offline.data.buffer import OfflineReplayBuffer
from sb3_offline.data.errors import DatasetError

CHUNK = 512


def fitted_q_evaluation(
    model: OfflineAlgorithm,
    buffer: OfflineReplayBuffer | None = None,
    n_steps: int = 5000,
    batch_size: int = 256,
    learning_rate: float = 1e-3,
    tau: float = 0.01,
    deterministic: bool = True,
    seed: int = 0,
) -> np.ndarray:
    """
    Fitted Q evaluation (https://arxiv.org/abs/1911.06854): a critic of its own is fitted to the policy's values,
    ``Q(s, a) = r + gamma (1 - terminated) Q(s', pi(s'))``, and asked for the episodes' first states. Neither the model nor
    any random generator changes.

    As every estimate from data alone, it knows nothing of actions that the data do not hold; it is least wrong for policies
    near them.

    :param model: any algorithm of this library; its ``gamma`` counts
    :param buffer: data to fit to, with rewards; default: the model's own, relabelled where it relabels
    :param n_steps: gradient steps
    :param batch_size: transitions in a batch
    :param learning_rate: of Adam
    :param tau: the soft update coefficient of the target
    :param deterministic: evaluate the policy's mode; otherwise the policy as it samples
    :param seed: of weights, batches and sampled actions
    :return: (E,) the values of the episodes' first states; their mean estimates the policy's discounted return
    """
    model._data.check_normalizer(model._vec_normalize_env)  # or the policy would see other observations than it learned from
    buffer = (model.replay_buffer if buffer is None else buffer).single_steps()
    if not buffer.has_rewards:
        remedy = "Evaluate on a dataset with rewards"
        raise DatasetError(buffer.datasets[0].path, "rewards", "are missing, so a policy has no value", remedy)
    env, policy = model._vec_normalize_env, model.policy
    policy.set_training_mode(False)
    rng = np.random.default_rng(seed)
    with th.random.fork_rng(devices=[model.device] if model.device.type == "cuda" else []):
        th.manual_seed(seed)
        critic, target = new_critic(policy), new_critic(policy)  # type: ignore[arg-type]
        target.load_state_dict(critic.state_dict())
        optimizer = th.optim.Adam(critic.parameters(), lr=learning_rate)
        for _ in range(n_steps):
            batch = buffer.transitions(rng.integers(buffer.size(), size=batch_size), env)
            with th.no_grad():
                actions = policy._predict(batch.next_observations, deterministic=deterministic)
                next_values = target.values(target.encode(batch.next_observations), actions).mean(dim=0)
                discounts = model.gamma * (1 - batch.dones.squeeze(1))
                targets = batch.rewards.squeeze(1) + discounts * next_values
            loss = bellman_loss(critic.values(critic.encode(batch.observations), batch.actions), targets)
            model._optimize(optimizer, loss)
            with th.no_grad():
                for new, old in zip(critic.parameters(), target.parameters(), strict=True):
                    old.lerp_(new, tau)
        critic.set_training_mode(False)
        return state_values(critic, model, buffer, first_steps(buffer), deterministic)


def new_critic(policy: OfflinePolicy) -> OfflineCritic:
    """:return: an untrained critic on a copy of the policy's encoder"""
    arguments = policy._update_features_extractor({**policy.critic_kwargs, "n_critics": 1}, None)
    critic = OfflineCritic(**arguments, layer_norm=policy.offline_critic_kwargs["layer_norm"]).to(policy.device)
    assert policy.actor.features_extractor is not None
    critic.features_extractor.load_state_dict(policy.actor.features_extractor.state_dict())
    return critic


def first_steps(buffer: OfflineReplayBuffer) -> np.ndarray:
    """:return: (E,) numbers of the episodes' first steps"""
    lengths = np.fromiter(chain.from_iterable(dataset.lengths for dataset in buffer.datasets), dtype=np.int64)
    return np.cumsum(lengths) - lengths


@th.no_grad()
def state_values(
    critic: OfflineCritic, model: OfflineAlgorithm, buffer: OfflineReplayBuffer, steps: np.ndarray, deterministic: bool = True
) -> np.ndarray:
    """
    :param critic: whose values; of several the lowest
    :param model: whose policy chooses the actions
    :param buffer: where the states are
    :param steps: (n,) their steps
    :param deterministic: take the policy's mode
    :return: (n,) ``Q(s, pi(s))``
    """

    def value(observations: PyTorchObs) -> th.Tensor:
        actions = model.policy._predict(observations, deterministic=deterministic)
        return critic.values(critic.encode(observations), actions).amin(dim=0)

    batches = batches_of(buffer, steps, model._vec_normalize_env)
    return np.concatenate([value(batch.observations).float().cpu().numpy() for batch in batches])


def batches_of(buffer: OfflineReplayBuffer, steps: np.ndarray, env: VecNormalize | None) -> Any:
    """:return: iterator over the transitions of these steps, a few hundred at a time"""
    return (buffer.transitions(steps[first : first + CHUNK], env) for first in range(0, len(steps), CHUNK))
