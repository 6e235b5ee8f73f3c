"""Fitted Q evaluation: the value of a policy, estimated from data alone."""

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
    Fitted Q evaluation (https://arxiv.org/abs/1911.06854): fits a new critic to the policy's values, ``Q(s, a) = r + gamma (1
    - terminated) Q(s', pi(s'))``, and evaluates it in the episodes' first states. Neither the model nor any random generator
    changes.

    Like every estimate from data alone, it has no information about actions outside the data. It is most accurate for
    policies near the data.

    :param model: a model of this library, whose ``gamma`` is used
    :param buffer: data with rewards to fit to; default: the model's own, with the rewards that it learns from
    :param n_steps: gradient steps
    :param batch_size: transitions in a batch
    :param learning_rate: learning rate of Adam
    :param tau: the soft update coefficient of the target
    :param deterministic: whether to evaluate the policy's mode instead of its samples
    :param seed: seed of weights, batches and sampled actions
    :return: (E,) values of the episodes' first states. Their mean estimates the policy's discounted return
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
    """:return: (E,) indices of the episodes' first steps"""
    lengths = np.fromiter(chain.from_iterable(dataset.lengths for dataset in buffer.datasets), dtype=np.int64)
    return np.cumsum(lengths) - lengths


@th.no_grad()
def state_values(
    critic: OfflineCritic,
    model: OfflineAlgorithm,
    buffer: OfflineReplayBuffer,
    indices: np.ndarray,
    deterministic: bool = True,
) -> np.ndarray:
    """
    :param critic: critic, of whose networks the lowest counts
    :param model: model whose policy chooses the actions
    :param buffer: buffer that holds the states
    :param indices: (n,) indices of their steps
    :param deterministic: whether to take the policy's mode
    :return: (n,) ``Q(s, pi(s))``
    """

    def value(observations: PyTorchObs) -> th.Tensor:
        actions = model.policy._predict(observations, deterministic=deterministic)
        return critic.values(critic.encode(observations), actions).amin(dim=0)

    batches = batches_of(buffer, indices, model._vec_normalize_env)
    return np.concatenate([value(batch.observations).float().cpu().numpy() for batch in batches])


def batches_of(buffer: OfflineReplayBuffer, indices: np.ndarray, env: VecNormalize | None) -> Any:
    """:return: iterator over the transitions with these indices, a few hundred at a time"""
    return (buffer.transitions(indices[first : first + CHUNK], env) for first in range(0, len(indices), CHUNK))
