"""Inputs drawn at random are read as they are meant, or refused in one line: never a traceback, a hang, or other data."""

import os
import subprocess
import sys
from pathlib import Path

from sb3_offline.experiment.check import check_all

#: Number of inputs; `make fuzz` draws more
INPUTS = int(os.environ.get("FUZZ_INPUTS", "200"))
SHARES = {"bytes": 0.4, "structure": 0.2, "arguments": 0.15, "configs": 0.15, "grids": 0.1}
PROGRAM = Path(__file__).with_name("fuzz.py")


def run_inputs(folder, batches):
    """:return: the outcome of each input, and the exit code of the process"""
    command = [sys.executable, str(PROGRAM), str(folder), *(f"{kind}:{first}:{last}" for kind, first, last in batches)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300 + 5 * INPUTS)
    outcomes = dict([*line.split(" ", 1), ""][:2] for line in done.stdout.splitlines())
    assert outcomes, done.stderr[-2000:]
    return outcomes, done.returncode


def test_drawn_inputs_are_right_or_refused(tmp_path):
    batches = [(kind, 0, max(round(share * INPUTS), 1)) for kind, share in SHARES.items()]
    wrong, found, ends = [], {}, {}
    while batches:
        outcomes, code = run_inputs(tmp_path, batches)
        found |= outcomes
        if code == 0:
            break
        kind, number = list(outcomes)[-1].split(":")
        # HDF5 crashed, or hung until a signal ended it: the command that checks files must survive that
        ends[code] = ends.get(code, 0) + 1
        files = [str(file) for file in tmp_path.glob("damaged_*") if kind == "bytes"]
        verdicts = list(check_all([max(files, key=os.path.getmtime)], seconds=3)) if files else []
        if not verdicts or not verdicts[0].damages:
            wrong.append(f"{kind}:{number} ends the process with {code}")
        kinds = [batch[0] for batch in batches]
        rest = batches[kinds.index(kind) :]
        batches = [(kind, int(number) + 1, rest[0][2]), *rest[1:]]
    wrong += [f"{name}: {text}" for name, text in found.items() if text.startswith("WRONG")]
    assert not wrong, "\n".join(wrong)
    right = sum(text == "right" for text in found.values())
    refused = len(found) - right - sum(ends.values())
    print(
        f"{len(found)} inputs: {right} right, {refused} refused; exit codes of processes in which HDF5 crashed or hung: {ends}"
    )
    assert len(found) >= 0.99 * INPUTS and 0 < right < len(found)
