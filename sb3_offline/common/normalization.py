"""Normalisation of observations by SB3's ``VecNormalize``: the statistics that a model learned with."""

from copy import deepcopy
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_offline.common.stub_env import SpacesOnlyEnv


class NormalizerStatistics(NamedTuple):
    """The attributes of a ``VecNormalize`` that decide how it normalises observations; see SB3."""

    obs_rms: Any
    clip_obs: float
    epsilon: float
    norm_obs_keys: list[str] | None


def normalizes(normalizer: VecNormalize | None) -> bool:
    """:return: whether an environment normalises observations"""
    return normalizer is not None and normalizer.norm_obs


def statistics_of(normalizer: VecNormalize) -> NormalizerStatistics:
    """:return: a copy of the statistics of a ``VecNormalize``"""
    return NormalizerStatistics(*(deepcopy(getattr(normalizer, name)) for name in NormalizerStatistics._fields))


def normalizer_from(
    statistics: NormalizerStatistics, observation_space: spaces.Space, action_space: spaces.Space
) -> VecNormalize:
    """
    :param statistics: the statistics of the environment that was normalised
    :param observation_space: observation space of that environment
    :param action_space: action space of that environment
    :return: a ``VecNormalize`` around a stub, which normalises observations by these statistics and never changes them
    """
    stub = DummyVecEnv([lambda: SpacesOnlyEnv(observation_space, action_space)])
    normalizer = VecNormalize(stub, training=False, norm_reward=False, norm_obs_keys=statistics.norm_obs_keys)
    for name, value in statistics._asdict().items():
        setattr(normalizer, name, value)
    return normalizer


def normalize_parts(normalizer: VecNormalize, observations: Any) -> Any:
    """
    :param normalizer: a ``VecNormalize``
    :param observations: a batch of observations, or a dict of batches that may lack keys
    :return: the normalised observations; those of ``normalize_obs`` if no key is missing
    """
    keys = normalizer.norm_obs_keys
    if not (isinstance(observations, dict) and normalizer.norm_obs and keys and set(keys) - observations.keys()):
        return normalizer.normalize_obs(observations)
    rms: Any = normalizer.obs_rms
    return {
        key: normalizer._normalize_obs(part, rms[key]).astype(np.float32) if key in keys else part
        for key, part in observations.items()
    }


def exceeds_clipping(observation: Any, statistics: NormalizerStatistics | VecNormalize) -> bool:
    """
    :param observation: an observation, a batch of these, or a dict of either
    :param statistics: of the normaliser, or the normaliser itself
    :return: whether the observation holds values that no normalised observation has
    """
    keys = statistics.norm_obs_keys
    parts = [observation[key] for key in keys or observation] if isinstance(observation, dict) else [observation]
    bound = statistics.clip_obs * (1 + 1e-6)
    return any(np.abs(np.asarray(part, np.float64)).max(initial=0) > bound for part in parts)
