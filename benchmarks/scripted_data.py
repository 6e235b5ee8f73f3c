"""
The scripted attempts, and success examples from other episodes, that the tables of scripted data are made from.

    python benchmarks/scripted_data.py
    python benchmarks/scripted_data.py --table second [--obs-type pixels]

The first command collects data/scripted1500.h5 and data/examples/state-TASK.h5, the second one data/second_states.h5 (or
second_pixels.h5) and data/second_states_examples/TASK.h5. Files that exist are kept.
"""

import argparse
from pathlib import Path

from sb3_offline.data.examples import save_examples
from sb3_offline.data.reader import OfflineDataset
from sb3_offline.data_tools.collecting.scripted import collect_scripted
from sb3_offline.data_tools.converting.extract_examples import extract_examples
from sb3_offline.envs.multimodal_metaworld.tables import TABLES, find_table

N_EXAMPLES, HELD_OUT_SEED, HELD_OUT_EPISODES = 200, 1000, 120


def prepare_data(args: argparse.Namespace) -> None:
    """Collect the files that are missing."""
    data, examples_dir, pattern, episodes_per_task = _defaults(args)
    held_out = examples_dir / "held_out.h5"
    files = {task: examples_dir / pattern.format(task=task) for task in find_table(args.table).tasks}
    missing = {task: file for task, file in files.items() if not file.exists()}
    for path, n_episodes, seed in ((data, episodes_per_task, 0), (held_out, HELD_OUT_EPISODES, HELD_OUT_SEED)):
        if not path.exists() and (path == data or missing):
            path.parent.mkdir(parents=True, exist_ok=True)
            unfinished = path.with_suffix(".unfinished.h5")
            shares = collect_scripted(
                unfinished,
                episodes_per_task=n_episodes,
                obs_type=args.obs_type,
                seed=seed,
                n_workers=args.workers,
                mode="w",
                table=args.table,
            )
            unfinished.rename(path)
            print(path, " ".join(f"{task} {share:.1%}" for task, share in shares.items()))
    for task, file in missing.items():
        examples, provenance = extract_examples(held_out, N_EXAMPLES, source=task, held_out=True)
        save_examples(file, examples, OfflineDataset(held_out).observation_space, provenance)


def _defaults(args: argparse.Namespace) -> tuple[Path, Path, str, int]:
    """:return: dataset, folder of the examples, their names, and episodes of each task"""
    observed = "states" if args.obs_type == "state" else "pixels"
    if args.table == "paper":
        data = Path(f"data/scripted1500{'' if observed == 'states' else '_pixels'}.h5")
        examples, pattern, episodes = Path("data/examples"), args.obs_type + "-{task}.h5", 1500
    else:
        data = Path(f"data/{args.table}_{observed}.h5")
        examples, pattern, episodes = Path(f"data/{args.table}_{observed}_examples"), "{task}.h5", 300
    return args.data or data, args.examples_dir or examples, pattern, args.episodes_per_task or episodes


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--table", choices=tuple(TABLES), default="paper")
    parser.add_argument("--obs-type", choices=("state", "pixels"), default="state")
    parser.add_argument("--data", type=Path)
    parser.add_argument("--episodes-per-task", type=int, help="default: 1500 for the paper's table, else 300")
    parser.add_argument("--examples-dir", type=Path)
    parser.add_argument("--workers", type=int, default=2)
    prepare_data(parser.parse_args())
