"""What a dataset of `collect-sac` is made of, as JSON."""

import json
import os
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sb3_offline.data.convert import convert
from sb3_offline.data.files import replacing
from sb3_offline.data.reader import OfflineDataset, open_datasets
from sb3_offline.data.selection import of_source
from sb3_offline.data_tools.collect_sac import PAPER_SHARES, content_hash, success_shares

SAMPLED_EPISODES = 100
"""Are compressed to measure the size of a frame."""


def write_card(path: Path, paths: Sequence[Path], seconds: float) -> dict[str, Any]:
    """
    :param path: the JSON file
    :param paths: of the dataset's files
    :param seconds: that their collection took in this run
    :return: what was written
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
        "command": " ".join(["sb3-offline", *sys.argv[1:]]),
        "seconds": round(seconds),
        "seed": first.provenance["seed"],
        "versions": first.provenance["versions"],
    }
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(card, indent=2) + "\n")
    return card


def _compressed_bytes(dataset: OfflineDataset) -> float:
    """:return: bytes of a decision in compressed storage, measured on the first episodes"""
    part = dataset.select(np.arange(min(SAMPLED_EPISODES, dataset.n_episodes)))
    with tempfile.TemporaryDirectory() as folder:
        convert(part, Path(folder) / "part.h5", "compressed", progress_bar=False)
        return os.path.getsize(Path(folder) / "part.h5") / part.n_steps
