"""Small dataset files for the tests of the data room."""

import os
import struct
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from gymnasium import spaces

from sb3_offline.data.writer import DatasetWriter

IMAGES = spaces.Box(0, 255, (8, 6, 3), np.uint8)
STATES = spaces.Box(-np.inf, np.inf, (3,), np.float32)
BOTH = spaces.Dict({"image": IMAGES, "state": STATES})
ACTIONS = spaces.Box(np.array([-2.0, 0.0], np.float32), np.array([2.0, 10.0], np.float32))
OPTIONS: dict[str, Any] = {"extras": {"qpos": ((2,), np.float64)}, "sources": ["left", "right"]}


def make_observations(space: spaces.Space, rows: int, rng: np.random.Generator) -> Any:
    if isinstance(space, spaces.Dict):
        return {key: make_observations(part, rows, rng) for key, part in space.items()}
    if space.dtype == np.uint8:
        return rng.integers(0, 256, (rows, *space.shape), dtype=np.uint8)
    return rng.normal(size=(rows, *space.shape)).astype(np.float32)


def make_episode(index: int, space: spaces.Space = IMAGES, n: int | None = None) -> dict[str, Any]:
    """Keyword arguments of ``add_episode``, the same for the same index; one in three terminates."""
    rng = np.random.default_rng(index)
    n = n or int(rng.integers(1, 13))
    terminated = np.zeros(n, dtype=bool)
    terminated[-1] = index % 3 == 0
    return {
        "observations": make_observations(space, n + 1, rng),
        "actions": rng.uniform(ACTIONS.low, ACTIONS.high, (n, 2)).astype(np.float32),
        "rewards": rng.normal(size=n).astype(np.float32),
        "terminated": terminated,
        "success": rng.random(n) < 0.3,
        "extras": {"qpos": rng.normal(size=(n, 2))},
        "seed": index,
        "source": "left" if index % 2 else "right",
    }


def write_dataset(
    path: Path, n_episodes: int = 12, space: spaces.Space = IMAGES, first: int = 0, **options: Any
) -> list[dict[str, Any]]:
    episodes = [make_episode(index, space) for index in range(first, first + n_episodes)]
    with DatasetWriter(path, space, ACTIONS, **{**OPTIONS, **options}) as writer:
        for episode in episodes:
            writer.add_episode(**episode)
    return episodes


def forget_checksums(file: h5py.File) -> None:
    """Make a file one of a writer that stored no checksums."""
    del file["episodes/crc"]
    for name in ("crc_fields", "crc_attributes"):
        del file.attrs[name]


def write_until_killed(path: Path, acknowledged: Path) -> None:
    """Append episodes for ever; ``acknowledged`` holds the number of those that ``add_episode`` returned for."""
    descriptor = os.open(acknowledged, os.O_WRONLY | os.O_CREAT)
    # Room for three episodes at first, so that the file outgrows its room again and again
    with DatasetWriter(path, IMAGES, ACTIONS, **OPTIONS, mode="a", capacity=(3, 30)) as writer:
        while True:
            writer.add_episode(**make_episode(writer.n_episodes))
            os.pwrite(descriptor, struct.pack("q", writer.n_episodes), 0)
