"""Actors of SB3's SAC as small files of weights, evaluated in NumPy: the same bits in every process, and no PyTorch needed."""

from __future__ import annotations

import os
from collections.abc import Mapping

import numpy as np

from sb3_offline.data.errors import DatasetError

# As in stable_baselines3.sac.policies.
_LOG_STD_LIMITS = (-20.0, 2.0)


class SacActor:
    """
    The squashed Gaussian policy of a ``stable_baselines3.SAC("MlpPolicy", ...)`` with ReLU layers.

    It computes in float64 and rounds actions to float32, so that the last bits of another machine's linear algebra get lost.

    :param weights: "0.weight" (n_out, n_in) and "0.bias" (n_out,) of the first layer, and so on; "mu.*", "log_std.*"
    """

    def __init__(self, weights: Mapping[str, np.ndarray]) -> None:
        n_hidden = sum(name.endswith(".weight") for name in weights) - 2
        names = [*map(str, range(n_hidden)), "mu", "log_std"]
        layers = [
            (weights[f"{name}.weight"].T.astype(np.float64), weights[f"{name}.bias"].astype(np.float64)) for name in names
        ]
        self._hidden, self._mean, self._log_std = layers[:-2], layers[-2], layers[-1]

    def act(self, state: np.ndarray, rng: np.random.Generator | None = None) -> np.ndarray:
        """
        :param state: (n,) float
        :param rng: to sample the action with; without it, the mode
        :return: (d,) float32 in [-1, 1]
        """
        latent = state.astype(np.float64)
        for weight, bias in self._hidden:
            latent = np.maximum(latent @ weight + bias, 0.0)
        action = latent @ self._mean[0] + self._mean[1]
        if rng is not None:
            log_std = np.clip(latent @ self._log_std[0] + self._log_std[1], *_LOG_STD_LIMITS)
            action = action + np.exp(log_std) * rng.normal(size=len(action))
        return np.tanh(action).astype(np.float32)


def actor_weights(state_dict: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """
    :param state_dict: of SB3's SAC actor, as arrays
    :return: what :class:`SacActor` takes, in float32
    """
    hidden = sorted((name for name in state_dict if name.startswith("latent_pi.")), key=lambda name: int(name.split(".")[1]))
    weights = {f"{i // 2}.{name.split('.')[2]}": state_dict[name] for i, name in enumerate(hidden)}
    weights |= {name: state_dict[name] for name in ("mu.weight", "mu.bias", "log_std.weight", "log_std.bias")}
    return {name: np.asarray(array, dtype=np.float32) for name, array in weights.items()}


def load_actor(path: str | os.PathLike[str]) -> SacActor:
    """
    :param path: of an .npz file with what :func:`actor_weights` returns
    :return: the actor
    """
    try:
        with np.load(path) as weights:
            return SacActor(dict(weights))
    except (OSError, KeyError, ValueError) as error:
        raise DatasetError(
            path, "weights", f"cannot be read ({error})", "Name a file written by sb3-offline train-sac"
        ) from error
