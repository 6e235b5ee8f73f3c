"""
How well success labels from examples agree with the hidden labels of the tables' data, task by task.

    python benchmarks/scripted_data.py --table second
    python benchmarks/labelling.py second states data/second_states.h5 data/second_states_examples
    python benchmarks/labelling.py second pixels data/second_pixels.h5 data/second_pixels_examples
    python benchmarks/labelling.py paper states data/sac_states.h5 data/sac_states_examples

writes results/labelling.csv, one row a task; rows of an earlier run for the same task are replaced. The labels are made by
label_episodes with its defaults, which were chosen on states of the second table. Only afterwards are they compared with
extras/task_success.
"""

import argparse
import csv
import time
from pathlib import Path
from typing import Any

import torch as th

from sb3_offline import label_episodes
from sb3_offline.common.provenance import current_commit
from sb3_offline.data.files import WriteLock, replacing
from sb3_offline.data.reader import OfflineDataset
from sb3_offline.labelling import ClassifierSettings, check_labels
from sb3_offline.labelling.episodes import solved_episodes

KEYS = ("table", "observations", "task", "seed")
FIELDS = (
    *KEYS,
    "episodes",
    "auc",
    "precision",
    "recall",
    "estimated_precision",
    "detected",
    "successes",
    "estimated_successes",
)
FIELDS = (*FIELDS, "estimated_low", "estimated_high", "settings", "seconds", "commit")


def measure(dataset: OfflineDataset, examples: Path, task: str, seed: int, settings: ClassifierSettings) -> dict[str, Any]:
    """:return: one row without its table and observations"""
    start = time.perf_counter()
    labels = label_episodes(dataset, examples / f"{task}.h5", settings=settings, seed=seed)
    seconds = time.perf_counter() - start
    check = check_labels(labels, solved_episodes([dataset], f"extras/task_success:{dataset.sources.index(task)}"))
    successes = labels.estimated_successes
    return {
        "task": task,
        "seed": seed,
        "episodes": dataset.n_episodes,
        "auc": f"{check.auc:.4f}",
        "precision": f"{check.precision:.3f}",
        "recall": f"{check.recall:.3f}",
        "estimated_precision": f"{labels.estimated_precision.value:.3f}",
        "detected": int(labels.detected.sum()),
        "successes": check.successes,
        "estimated_successes": f"{successes.value:.0f}",
        "estimated_low": f"{successes.low:.0f}",
        "estimated_high": f"{successes.high:.0f}",
        "settings": "defaults" if settings == ClassifierSettings() else str(settings),
        "seconds": f"{seconds:.0f}",
    }


def add_row(path: Path, row: dict[str, Any]) -> None:
    """Write a row in the place of that for the same task. Several programs may do so at a time."""
    with WriteLock(path, wait=True) as lock:
        rows = list(csv.DictReader(path.open(encoding="utf-8"))) if path.exists() else []
        rows = [old for old in rows if any(old[key] != str(row[key]) for key in KEYS)] + [row]
        rows.sort(key=lambda each: tuple(str(each[key]) for key in KEYS))
        with replacing(path, lock) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, FIELDS, lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", help="paper or second")
    parser.add_argument("observations", help="states or pixels")
    parser.add_argument("dataset", help="data with extras/task_success")
    parser.add_argument("examples", type=Path, help="folder of TASK.h5")
    parser.add_argument("--tasks", nargs="*", help="default: all")
    parser.add_argument("--seeds", type=int, nargs="*", default=[0])
    parser.add_argument("--steps", type=int, help="gradient steps of each network (default: the classifier's)")
    parser.add_argument("--threads", type=int, help="threads of PyTorch")
    parser.add_argument("--output", type=Path, default=Path("results/labelling.csv"))
    args = parser.parse_args()
    if args.threads:
        th.set_num_threads(args.threads)
    dataset, commit = OfflineDataset(args.dataset), current_commit()  # now, since the code may change while this runs
    for task in args.tasks or dataset.sources:
        for seed in args.seeds:
            row = measure(dataset, args.examples, task, seed, ClassifierSettings(gradient_steps=args.steps))
            print(row, flush=True)
            add_row(args.output, {"table": args.table, "observations": args.observations, **row, "commit": commit})


if __name__ == "__main__":
    main()
