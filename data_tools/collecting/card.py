"""A description of a dataset of `collect-sac` as JSON."""

import json
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sb3_offline.data.convert import convert
from sb3_offline.data.files import replacing
from sb3_offline.data.reader import OfflineDataset, open_datasets
from sb3_offline.data.selection import of_source
from sb3_offline.data_tools.collecting.sac import PAPER_SHARES, content_hash, success_shares

SAMPLED_EPISODES = 100
"""Number of episodes that are compressed to measure the size of a compressed decision."""


def write_card(path: Path, paths: Sequence[Path], seconds: float, command: str) -> dict[str, Any]:
    """
    Write the card of a dataset: its tasks, sizes, hash, seed and versions.

    :param path: the JSON file
    :param paths: files of the dataset
    :param seconds: duration of the collection in this run
    :param command: command line that collected the data
    :return: the card
    """
    datasets = open_datasets(list(paths))
    first = datasets[0]
    n_steps = sum(dataset.n_steps for dataset in datasets)
    n_episodes = sum(dataset.n_episodes for dataset in datasets)
    sizes = [os.path.getsize(dataset.path) for dataset in datasets]
    counts = {task: sum(int(of_source(dataset, task).sum()) for dataset in datasets) for task in first.sources}
    card = {
        "tasks": {
            task: {
                "episodes": counts[task],
                "success_share": round(share, 4),
                "paper_share": PAPER_SHARES[task],
                "mix": first.provenance["mix"][task],
            }
            for task, share in success_shares(datasets).items()
        },
        "episodes": n_episodes,
        "decisions": n_steps,
        "obs_type": first.env_kwargs["obs_type"],
        "files": len(datasets),
        "bytes": sum(sizes),
        "bytes_per_decision": {
            "contiguous": round(sum(sizes) / n_steps, 1),
            "compressed": round(_compressed_bytes(first), 1),
            "compressed_sample_episodes": min(SAMPLED_EPISODES, first.n_episodes),
        },
        "sha256_actions_and_scene_states": content_hash(datasets),
        "command": command,
        "seconds": round(seconds),
        "seed": first.provenance["seed"],
        "versions": first.provenance["versions"],
    }
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(card, indent=2) + "\n")
    return card


def _compressed_bytes(dataset: OfflineDataset) -> float:
    """:return: bytes per decision in compressed storage, measured on the first episodes"""
    part = dataset.select(np.arange(min(SAMPLED_EPISODES, dataset.n_episodes)))
    with tempfile.TemporaryDirectory() as folder:
        convert(part, Path(folder) / "part.h5", "compressed", progress_bar=False)
        return os.path.getsize(Path(folder) / "part.h5") / part.n_steps
