"""
Measure whether `torch.compile` makes steps faster: CEBORL as it is takes turns with CEBORL with one part compiled.

    python benchmarks/compiled.py

This adds the rows `compiled_...` to results/throughput.json. It needs a C++ compiler, and takes minutes, mostly to compile.
"""

import json
import tempfile
import time
from pathlib import Path
from typing import Any

import torch as th
from throughput import OBSERVATIONS, RESULTS, comparison, interleave, merge, one_step, ours, write_transitions

from sb3_offline.common.process import prepare_process

#: Method of the critics that is compiled, for each kind of observations
PARTS = {"states": "values", "pixels": "encode"}
ROUNDS, SECONDS = 5, 1.0


def main() -> None:
    prepare_process()
    entries: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        for kind, part in PARTS.items():
            data = Path(folder) / f"{kind}.h5"
            write_transitions(data, OBSERVATIONS[kind])
            models = {name: ours("ceborl", kind, data, mixed_precision=True) for name in ("as it is", "compiled")}
            for critic in (models["compiled"].critic, models["compiled"].critic_target):
                setattr(critic, part, th.compile(getattr(critic, part)))
            steps = {name: one_step(model) for name, model in models.items()}
            began = time.perf_counter()
            for _ in range(5):  # Batches have several sizes, and each is compiled.
                steps["compiled"]()
            seconds = time.perf_counter() - began
            name = f"compiled_{part}_ceborl_{kind}_bf16"
            entries.append(
                {
                    **comparison(name, interleave(steps, ROUNDS, SECONDS), "compiled", "as it is"),
                    "seconds_to_compile": round(seconds, 1),
                }
            )
    merge(RESULTS, entries)
    for entry in entries:
        print(json.dumps(entry))


if __name__ == "__main__":
    main()
