"""Export of offline models to Stable-Baselines3's SAC, which goes on learning online."""

import os
from pathlib import Path
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.td3.policies import Actor as DeterministicActor

from sb3_offline.common.actor_critic import ActorCriticAlgorithm
from sb3_offline.common.offline_algorithm import OfflineAlgorithm
from sb3_offline.common.policies import CnnPolicy, MlpPolicy, MultiInputPolicy, OfflinePolicy
from sb3_offline.common.reward_based import RewardBasedAlgorithm
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.mixed import MixedDictReplayBuffer, MixedReplayBuffer

#: Standard deviation before the tanh that a deterministic policy is given
ADDED_STD = 0.1


def export_sac(
    model: OfflineAlgorithm,
    path: str | os.PathLike,
    *,
    data_ratio: float = 0.0,
    buffer_size: int = 1_000_000,
    learning_starts: int = 0,
    ent_coef: str | float = "auto_0.01",
    **kwargs: Any,
) -> None:
    """
    Save an actor-critic as a zip that ``SAC.load(path, env=env)`` of Stable-Baselines3 opens, and that predicts as the model.

    The policy keeps its class, which is a subclass of SAC's policy. So the critic alone goes on training a shared encoder, and
    observations are standardised as before.

    Critics that learned from rewards are kept. Critics that learned from examples do not estimate rewards, so SAC gets new
    ones on the same encoder; where that sees the keys of the examples only, on a copy of the policy's. A deterministic actor
    gets a standard deviation of 0.1 before the tanh. A model with ``n_stack`` becomes a SAC that sees stacks, to be loaded
    with an environment in a ``VecFrameStack``.

    :param model: trained actor-critic. If it learned with a ``VecNormalize``, that must be its environment, and SAC must be
        loaded with it too
    :param path: path of the zip
    :param data_ratio: share of each of SAC's batches that comes from the model's dataset, which must have rewards
    :param buffer_size: see :class:`stable_baselines3.sac.SAC`
    :param learning_starts: environment steps with random actions; with SAC's default, 100, the policy would not act at first
    :param ent_coef: entropy coefficient; SAC's default starts at 1, where the entropy outweighs the rewards
    :param kwargs: further arguments of :class:`stable_baselines3.sac.SAC`; learning rate, batch size, ``tau``, ``gamma`` and
        seed default to the model's
    :raises TypeError: if the model has no critic
    :raises RuntimeError: if the model learned with a ``VecNormalize`` and its environment is none
    :raises ValueError: if ``data_ratio`` is not between 0 and 1
    :raises DatasetError: if ``data_ratio`` is positive and the dataset has no rewards
    """
    if not isinstance(model, ActorCriticAlgorithm):
        remedy = "export an actor-critic, such as CQL, IQL, TD3BC or CEBORL"
        raise TypeError(f"{type(model).__name__} has no critic for SAC to go on with; {remedy}")
    model._data.check_normalizer(model._vec_normalize_env)
    if not 0 <= data_ratio <= 1:
        raise ValueError(f"data_ratio is {data_ratio}; give a share between 0 and 1")
    keeps_critic = isinstance(model, RewardBasedAlgorithm)
    policy_kwargs = {k: v for k, v in model.all_policy_kwargs().items() if k not in ("critic_state_value", "critic_keys")}
    if not keeps_critic:
        policy_kwargs.pop("critic_output_bias", None)
    arguments = {name: getattr(model, name) for name in ("learning_rate", "batch_size", "tau", "gamma", "device")}
    seed = kwargs.pop("seed", model.seed)  # The constructor would seed all generators of this process with it.
    sac = SAC(
        _policy_class(model.policy),
        model.get_env(),  # type: ignore[arg-type]
        buffer_size=1,  # The buffer of this object stays empty.
        learning_starts=learning_starts,
        ent_coef=ent_coef,
        policy_kwargs=policy_kwargs,
        **{**arguments, **kwargs},
    )
    _copy_weights(model.policy, sac.policy, keeps_critic)  # type: ignore[arg-type]
    sac.buffer_size, sac.seed = buffer_size, seed
    if data_ratio > 0:
        is_dict = isinstance(model.observation_space, spaces.Dict)
        sac.replay_buffer_class = MixedDictReplayBuffer if is_dict else MixedReplayBuffer
        buffer = model.replay_buffer
        if not buffer.has_rewards:
            problem, remedy = "are missing, but SAC learns from them", "Give a dataset with rewards, or data_ratio=0"
            raise DatasetError(buffer.datasets[0].path, "rewards", problem, remedy)
        sac.replay_buffer_kwargs = {"dataset": model.dataset, "data_ratio": data_ratio}
        if model.n_stack > 1:
            sac.replay_buffer_kwargs["n_stack"] = model.n_stack
        if buffer.is_relabelled:  # SAC goes on with the rewards that the critic learned from.
            sac.replay_buffer_kwargs.update(rewards=buffer.rewards, checksum=buffer.checksum())
    sac.save(Path(path))


def _policy_class(policy: OfflinePolicy) -> type[OfflinePolicy]:
    if not isinstance(policy.actor, DeterministicActor):
        return type(policy)
    classes = (MlpPolicy, CnnPolicy, MultiInputPolicy)
    return next(c for c in classes if c.default_features_extractor_class is policy.default_features_extractor_class)


@th.no_grad()
def _copy_weights(source: OfflinePolicy, target: OfflinePolicy, keeps_critic: bool) -> None:
    wanted = target.state_dict()
    weights = {name: value for name, value in source.state_dict().items() if name in wanted}
    if isinstance(source.actor, DeterministicActor):
        layers = [layer for layer in source.actor.mu if isinstance(layer, th.nn.Linear)]
        copies = [layer for layer in target.actor.latent_pi if isinstance(layer, th.nn.Linear)] + [target.actor.mu]
        for layer, copy in zip(layers, copies, strict=True):
            copy.load_state_dict(layer.state_dict())  # type: ignore[union-attr]
        target.actor.log_std.weight.zero_()  # type: ignore[union-attr, operator]
        target.actor.log_std.bias.fill_(th.tensor(ADDED_STD).log())  # type: ignore[union-attr, operator]
        weights = {name: value for name, value in weights.items() if not name.startswith(("actor.mu", "actor.log_std"))}
    if source.critic_keys is not None:
        weights = {name: value for name, value in weights.items() if name.startswith("actor.")}
    elif not keeps_critic:
        weights = {name: value for name, value in weights.items() if not name.startswith(("critic.qf", "critic_target.qf"))}
    target.load_state_dict(weights, strict=False)
    if source.critic_keys is not None:
        target.critic.features_extractor.load_state_dict(target.actor.features_extractor.state_dict())
    if not keeps_critic:
        target.critic_target.load_state_dict(target.critic.state_dict())
