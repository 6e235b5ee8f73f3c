"""
All methods on all tasks from state observations, with several seeds: the table of the docs.

    python benchmarks/states_table.py --data data/scripted1500.h5 --examples-dir data/examples

collects data and examples where they are missing, trains every cell of the table (finished ones are kept, so it can be stopped
and started again) and writes results/ceborl_states.csv, one row a checkpoint. The protocol stands in benchmarks/cells.py.
"""

import argparse
from typing import Any

from cells import ENV_ID, TASKS, add_arguments, cell_run, prepare_data, train_cells, write_rows

from sb3_offline.experiment.config import load_config

#: Row of the table: algorithm, shipped config, what is changed in it.
METHODS: dict[str, tuple[str, str, dict[str, Any]]] = {
    "ceborl": ("ceborl", "ceborl", {}),
    "ceborl_paper": ("ceborl", "ceborl_paper", {}),
    "rce_1step": ("rce", "rce", {"n_steps": 1}),
    "rce_10step": ("rce", "rce", {"n_steps": 10}),
    "bc": ("bc", "bc", {}),
    "bc_filtered": ("bc", "bc_filtered", {}),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_arguments(parser, "runs/states_table", "ceborl_states.csv", list(TASKS), [0, 1, 2])
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    args = parser.parse_args()

    prepare_data(args)
    cells = []
    # Seeds outside, so that a table that was stopped early is one of fewer seeds
    for seed, task, method in ((seed, task, method) for seed in args.seeds for task in args.tasks for method in args.methods):
        algo, config_name, changes = METHODS[method]
        run = cell_run(args, algo, {**load_config(config_name, ENV_ID), **changes}, method, task, seed)
        config = " ".join([config_name, *(f"{key}={value}" for key, value in changes.items())])
        cells.append(({"method": method, "task": task, "seed": seed, "config": config}, run))
    if not args.no_training:
        train_cells([run for _, run in cells], args.workers)
    write_rows(args.output, cells)


if __name__ == "__main__":
    main()
