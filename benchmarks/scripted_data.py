"""
The scripted attempts, and success examples from episodes apart from them, that the tables of scripted data are made from.

    python benchmarks/scripted_data.py

collects data/scripted1500.h5 and data/examples/state-TASK.h5 where they are missing.
"""

import argparse
from pathlib import Path

from sb3_offline.data.examples import save_examples
from sb3_offline.data.reader import OfflineDataset
from sb3_offline.data_tools.collecting.scripted import TASKS, collect_scripted
from sb3_offline.data_tools.converting.extract_examples import extract_examples

N_EXAMPLES, HELD_OUT_SEED, HELD_OUT_EPISODES = 200, 1000, 120


def prepare_data(args: argparse.Namespace) -> None:
    """Collect what is missing."""
    held_out = args.examples_dir / "held_out.h5"
    files = {task: args.examples_dir / f"state-{task}.h5" for task in TASKS}
    missing = {task: file for task, file in files.items() if not file.exists()}
    for path, n_episodes, seed in ((args.data, args.episodes_per_task, 0), (held_out, HELD_OUT_EPISODES, HELD_OUT_SEED)):
        if not path.exists() and (path == args.data or missing):
            path.parent.mkdir(parents=True, exist_ok=True)
            unfinished = path.with_suffix(".unfinished.h5")
            collect_scripted(unfinished, episodes_per_task=n_episodes, seed=seed, n_workers=args.workers, mode="w")
            unfinished.rename(path)
    for task, file in missing.items():
        examples, provenance = extract_examples(held_out, N_EXAMPLES, source=task, held_out=True)
        save_examples(file, examples, OfflineDataset(held_out).observation_space, provenance)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("data/scripted1500.h5"))
    parser.add_argument("--episodes-per-task", type=int, default=1500)
    parser.add_argument("--examples-dir", type=Path, default=Path("data/examples"))
    parser.add_argument("--workers", type=int, default=2)
    prepare_data(parser.parse_args())
