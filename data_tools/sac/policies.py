"""Actors of SB3's SAC as small weight files, evaluated in NumPy: the same bits in every process, and no PyTorch needed."""

from __future__ import annotations

import hashlib
import json
import os
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sb3_offline.data.errors import DatasetError

# As in stable_baselines3.sac.policies.
_LOG_STD_LIMITS = (-20.0, 2.0)


class SacActor:
    """
    The squashed Gaussian policy of a ``stable_baselines3.SAC("MlpPolicy", ...)`` with ReLU layers.

    It computes in float64 and rounds actions to float32, so that differences in the last bits between machines disappear.

    :param weights: "0.weight" (n_out, n_in) and "0.bias" (n_out,) of the first layer, and so on; "mu.*" and "log_std.*"
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
        :param rng: generator to sample the action with; without it, the action is the mode
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


def actor_weights(
    state_dict: Mapping[str, np.ndarray], offset: np.ndarray | float = 0.0, scale: np.ndarray | float = 1.0
) -> dict[str, np.ndarray]:
    """
    Convert the weights of a SAC actor to those of :class:`SacActor`, and fold the scaling of the states into the first layer.

    :param state_dict: state dict of SB3's SAC actor, as arrays
    :param offset: (n,) or a number; the actor was trained on ``(state - offset) / scale``
    :param scale: (n,) or a number
    :return: float32 weights for unscaled states
    """
    hidden = sorted((name for name in state_dict if name.startswith("latent_pi.")), key=lambda name: int(name.split(".")[1]))
    weights = {f"{int(name.split('.')[1]) // 2}.{name.split('.')[2]}": state_dict[name] for name in hidden}
    weights |= {name: state_dict[name] for name in ("mu.weight", "mu.bias", "log_std.weight", "log_std.bias")}
    first = weights["0.weight"].astype(np.float64) / scale
    weights |= {"0.weight": first, "0.bias": weights["0.bias"] - (first * offset).sum(axis=1)}
    return {name: np.asarray(array, dtype=np.float32) for name, array in weights.items()}


def load_actor(path: str | os.PathLike[str]) -> SacActor:
    """
    :param path: .npz file with the arrays that :func:`actor_weights` returns
    :return: the actor; raises ``DatasetError`` if the file cannot be read
    """
    try:
        with np.load(path) as weights:
            return SacActor(dict(weights))
    except (OSError, EOFError, KeyError, ValueError, zipfile.BadZipFile) as error:
        raise DatasetError(
            path, "weights", f"cannot be read ({error})", "Name a file written by sb3-offline train-sac"
        ) from error


@dataclass(frozen=True)
class Checkpoint:
    """
    One actor of a task, and its measured success with sampled actions.

    :param file: path of its weights
    :param sha256: digest of the file
    :param run: name of the training run
    :param step: number of decisions that it was trained for
    :param successes: number of solved episodes
    :param episodes: number of episodes played
    """

    file: Path
    sha256: str
    run: str
    step: int
    successes: int
    episodes: int

    @property
    def success_rate(self) -> float:
        """Share of solved episodes."""
        return self.successes / self.episodes


def load_policies(folder: str | os.PathLike[str]) -> dict[str, list[Checkpoint]]:
    """
    :param folder: folder that ``sb3-offline select-sac`` wrote, with ``policies.json`` and the files that it names
    :return: checkpoints by task; raises ``DatasetError`` if a file is not the one that was measured
    """
    path = Path(folder) / "policies.json"
    remedy = "Name a folder written by sb3-offline select-sac"
    try:
        tasks = json.loads(path.read_text())["tasks"]
    except (OSError, EOFError, KeyError, ValueError, zipfile.BadZipFile) as error:
        raise DatasetError(path, "file", f"cannot be read ({error})", remedy) from error
    policies = {}
    for task, entry in tasks.items():
        policies[task] = [Checkpoint(**{**values, "file": path.parent / values["file"]}) for values in entry["checkpoints"]]
        for checkpoint in policies[task]:
            if file_sha256(checkpoint.file) != checkpoint.sha256:
                raise DatasetError(checkpoint.file, "sha256", "is not the one in policies.json", remedy)
    return policies


def file_sha256(path: str | os.PathLike[str]) -> str:
    """
    :param path: path of a small file
    :return: hexadecimal digest, or "" if there is no such file
    """
    return hashlib.sha256(Path(path).read_bytes()).hexdigest() if Path(path).exists() else ""


def mix_weights(success_rates: Sequence[float], share: float) -> np.ndarray:
    """
    Find the most even mix of checkpoints with the expected success `share`: the weights of greatest entropy, which are
    proportional to ``exp(k * success_rate)``.

    :param success_rates: (n,) measured success rates of the checkpoints
    :param share: wanted share of successful episodes in the data
    :return: (n,) float64, share of the episodes that each checkpoint plays; if no mix reaches `share`, the nearest one
    """
    rates = np.asarray(success_rates, dtype=np.float64)

    def weights(k: float) -> np.ndarray:
        unnormalised = np.exp(k * (rates - rates.max() if k > 0 else rates - rates.min()))
        return unnormalised / unnormalised.sum()

    low, high = -1e3, 1e3
    for _ in range(100):
        middle = (low + high) / 2
        low, high = (middle, high) if weights(middle) @ rates < share else (low, middle)
    return weights(low)
