"""A small grid, its data and its rows, for the tests of the benchmark."""

from pathlib import Path
from typing import Any

import torch as th
import yaml

from sb3_offline.benchmark.table import table_rows
from sb3_offline.data.examples import save_examples
from sb3_offline.data.reader import OfflineDataset
from sb3_offline.data_tools.collecting.scripted import collect_scripted
from sb3_offline.data_tools.converting.extract_examples import extract_examples

GRID: dict[str, Any] = {
    "env": "MultimodalMetaworld-v0",
    "tasks": ["door-open", "drawer-open"],
    "seeds": [3],
    "n_timesteps": 40,
    "save_freq": 5,
    "checkpoints": 2,
    "episodes": 1,
    "methods": {
        "ceborl": {"algo": "ceborl", "config": "ceborl", "changes": {"batch_size": 16}},
        "cql": {"algo": "cql", "config": "cql", "changes": {"batch_size": 16}},
        "bc": {"algo": "bc", "config": "bc"},
    },
}


def collect_data(folder: Path) -> dict[str, str]:
    """:return: keys of a grid"""
    collect_scripted(folder / "data.h5", episodes_per_task=8, tasks=GRID["tasks"], n_workers=1)
    dataset = OfflineDataset(folder / "data.h5")
    for task in GRID["tasks"]:
        examples, provenance = extract_examples(folder / "data.h5", 5, source=task)
        save_examples(folder / f"{task}.h5", examples, dataset.observation_space, provenance)
    return {"dataset": str(folder / "data.h5"), "examples": str(folder / "{task}.h5")}


def write_grid(folder: Path, data: dict[str, str], **changes: Any) -> str:
    (folder / "grid.yml").write_text(yaml.safe_dump({**GRID, **data, **changes}))
    return str(folder / "grid.yml")


def rows_of(cells: dict) -> list[dict[str, Any]]:
    """:return: rows of the table without their commit, since somebody may commit meanwhile"""
    return [{name: value for name, value in row.items() if name != "commit"} for row in table_rows(cells)]


def assert_same(one: Any, other: Any) -> None:
    """Compare nested dicts and lists of tensors, such as policies and optimizers."""
    if isinstance(one, th.Tensor):
        assert th.equal(one, other)
    elif isinstance(one, dict):
        assert one.keys() == other.keys()
        assert_same(list(one.values()), list(other.values()))
    elif isinstance(one, list | tuple):
        assert len(one) == len(other)
        for pair in zip(one, other, strict=True):
            assert_same(*pair)
    else:
        assert one == other
