"""
Inputs that are drawn at random, each with the outcome of opening it. ``test_fuzz.py`` runs this file in processes.

    python tests/fuzz.py FOLDER KIND:FIRST:LAST ...

Each line of the output is "KIND:NUMBER right", "KIND:NUMBER refused: ..." or "KIND:NUMBER WRONG: ...". It is cut off where the
process died. An input is drawn from the seed, its kind and its number alone.
"""

import contextlib
import io
import json
import os
import pickle
import signal
import sys
import traceback
import warnings
from pathlib import Path

import h5py
import numpy as np
import torch as th
import yaml
from data_files import ACTIONS, BOTH, IMAGES, OPTIONS, STATES, forget_checksums, make_episode, write_dataset

from sb3_offline.benchmark.grid import load_grid, plan
from sb3_offline.data.check import check_dataset
from sb3_offline.data.convert import convert
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.examples import load_examples, save_examples
from sb3_offline.data.reader import OfflineDataset
from sb3_offline.data.writer import DatasetWriter
from sb3_offline.experiment.check import check
from sb3_offline.experiment.config import load_config
from sb3_offline.experiment.training import create_model, load_run, train

SEED = int(os.environ.get("FUZZ_SEED", "1"))
SECONDS = 2  # of the processor, after which a signal ends a process that hangs in one input
CONFIG = {"policy": "MlpPolicy", "policy_kwargs": {"net_arch": [8]}, "batch_size": 8, "n_timesteps": 2}


def prepare(folder):
    """Write the whole files that are damaged later."""
    write_dataset(folder / "contiguous.h5", 6, BOTH)
    convert(folder / "contiguous.h5", folder / "compressed.h5", "compressed", progress_bar=False)
    write_dataset(folder / "states.h5", 6, STATES)
    save_examples(folder / "examples.h5", np.ones((5, 3), np.float32), STATES)
    with h5py.File(folder / "d4rl.h5", "w") as file:
        for name, shape in (("observations", (40, 3)), ("actions", (40, 2)), ("rewards", (40,))):
            file[name] = np.zeros(shape, np.float32)
        for name in ("terminals", "timeouts"):
            file[name] = np.arange(40) % 10 == (9 if name == "timeouts" else 10)
    rollouts = {"obs": np.zeros((42, 3)), "acts": np.zeros((40, 1)), "rews": np.zeros(40), "terminal": np.ones(2, bool)}
    np.savez(folder / "rollouts.npz", indices=[20], **rollouts)
    with (folder / "list.pkl").open("wb") as file:
        pickle.dump([{"observations": np.zeros((4, 3)), "actions": np.zeros((3, 2)), "rewards": np.zeros(3)}] * 3, file)
    train("bc", "Pendulum-v1", CONFIG, folder / "run", dataset=str(folder / "states.h5"), progress_bar=False)


def contents(path):
    dataset = OfflineDataset(path)
    about = [dataset.header.attributes(), sorted(dataset.arrays)]
    return about, {name: np.asarray(array[:]) for name, array in dataset.arrays.items()}


def same(path, whole):
    (about, arrays), (whole_about, whole_arrays) = contents(path), contents(whole)
    return about == whole_about and all(arrays[name].tobytes() == whole_arrays[name].tobytes() for name in arrays)


def refused(lines, path):
    """:return: the outcome of an error, which must name the file in one line"""
    bad = [line for line in lines if "\n" in line or path.name not in line or not line.isprintable()]
    return f"WRONG: says {bad[0][:200]!r}" if bad else f"refused: {lines[0][-150:]}"


def damaged_bytes(rng, folder):
    names = ["contiguous.h5", "compressed.h5", "examples.h5", "d4rl.h5", "rollouts.npz", "list.pkl", "run/model.zip"]
    source = folder / names[rng.choice(len(names), p=[0.35, 0.2, 0.1, 0.1, 0.1, 0.05, 0.1])]
    raw = bytearray(source.read_bytes())
    end = len(raw) if rng.random() < 0.5 else min(len(raw), 8000)  # the structure of an HDF5 file is at its beginning
    for _ in range(rng.integers(1, 5)):
        place, size = int(rng.integers(end)), int(rng.integers(1, 64))
        match int(rng.integers(5)):
            case 0 | 1:
                raw[place] ^= 1 << int(rng.integers(8))
            case 2:
                raw[place : place + size] = bytes(len(raw[place : place + size]))
            case 3:
                raw[place : place + size] = rng.bytes(len(raw[place : place + size]))
            case 4 if rng.random() < 0.3:
                del raw[place:]
                end = max(len(raw), 1)
                raw += bytes(not raw)
    path = folder / f"damaged_{source.name}"
    path.write_bytes(raw)
    verdict = check(os.fspath(path))
    with contextlib.suppress(DatasetError):
        OfflineDataset(path) if source.name != "model.zip" else None
    if verdict.damages:
        return refused(verdict.damages, path)
    is_covered = source.name in ("contiguous.h5", "compressed.h5")
    if is_covered and not verdict.notes and not same(path, source):
        return "WRONG: accepted, but other data"
    if source.name == "examples.h5" and not (load_examples(path, STATES) == 1).all():
        return "WRONG: accepted, but other examples"
    return "right"


ODD = [
    *(0, -1, 1.5, 2**62, np.nan, np.inf, "", "x", b"\xff\x00", True, [1], [[1], [2, 3]], {}, None, 10**400),
    *(np.zeros(0), np.zeros((2, 2)), np.array(["a"]), np.array([None]), np.full(3, np.nan), np.zeros(3, "c8"), "a\x1b[2J"),
]


def odd(rng):
    return ODD[rng.integers(len(ODD))]


def damaged_structure(rng, folder):
    source = folder / ["contiguous.h5", "states.h5"][rng.integers(2)]
    path = folder / "edited.h5"
    path.write_bytes(source.read_bytes())
    keeps = rng.random() < 0.6
    with h5py.File(path, "r+") as file:
        if not keeps:
            forget_checksums(file)
        names = ["observations", "actions", "rewards", "terminated", "extras/qpos", "n_episodes"]
        names += ["episodes/length", "episodes/seed", "episodes/source", "episodes", "extras", "success", "observations/state"]
        name = names[rng.integers(len(names))]
        with contextlib.suppress(TypeError, ValueError, KeyError, OSError, RuntimeError, OverflowError, AttributeError):
            match int(rng.integers(8)):
                case 0:
                    del file[name]
                case 1:
                    del file[name]
                    file[name] = odd(rng)
                case 2:
                    attributes = [*file.attrs]
                    file.attrs[attributes[rng.integers(len(attributes))]] = odd(rng)
                case 3:
                    attributes = [key for key in file.attrs if isinstance(file.attrs[key], str)]
                    file.attrs[attributes[rng.integers(len(attributes))]] = json.dumps(odd(rng), default=str)
                case 4:
                    del file[name]
                    target = h5py.SoftLink("/actions") if rng.random() < 0.5 else h5py.ExternalLink("states.h5", "/actions")
                    file[name] = target
                case 5:
                    file[name][rng.integers(len(file[name]))] = odd(rng)
                case 6:
                    file["n_episodes"][()] = int(rng.integers(-2, 9))
                case 7:
                    values = file[name][()]
                    del file[name]
                    file[name] = values[: rng.integers(len(values))] if rng.random() < 0.5 else values.astype("f8")
    verdict = check_dataset(path)
    if verdict.damages:
        return refused(verdict.damages, path)
    if keeps and not verdict.notes and not same(path, source):
        return "WRONG: accepted, but other data"
    return "right"


def arguments(rng, folder):
    """Arguments of the writer and of selections; a refused episode must leave the file as it was."""
    path = folder / "written.h5"
    space = [IMAGES, STATES, BOTH][rng.integers(3)]
    options, is_usual = dict(OPTIONS), rng.random() < 0.7
    if not is_usual:
        key = ["extras", "sources", "env_kwargs", "provenance", "env_id"][rng.integers(5)]
        options[key] = {"a": odd(rng)} if key == "extras" else odd(rng)
    with DatasetWriter(path, space, ACTIONS, mode="w", **options) as writer:
        if is_usual:
            writer.add_episode(**make_episode(0, space))
            given = make_episode(1, space)
            for _ in range(rng.integers(1, 3)):
                given[[*given][rng.integers(len(given))]] = odd(rng)
            try:
                writer.add_episode(**given)
            except DatasetError as error:
                if "\n" in str(error) or path.name not in str(error):
                    return f"WRONG: says {error}"
            writer.add_episode(**make_episode(2, space))
    dataset = OfflineDataset(path)
    if is_usual:
        assert dataset.seeds[0] == 0 and dataset.seeds[-1] == 2 and not check_dataset(path).damages
        dataset.select([odd(rng)] if rng.random() < 0.5 else odd(rng))
    return "right"


VALUES = [
    *(".inf", ".nan", "-1", "0", "1e400", "x", "[]", "{}", "null", "true", "[1, 2]", "{a: 1}", "''", "3e-4", "lin_x", "1.5"),
    *("&a [*a]", "*b", "!!python/object/apply:os.system [ls]", "!!binary x", "2001-01-01", "'{task}'", "10", "0.5", "[[1]]"),
    *("'a\\x1b'", "? x", "|\n   text", "!!set {a}", "-" * 50, "9" * 400, "dict(a=1)", "auto", "cuda:9", "Model"),
]


def random_yaml(rng):
    known = ["gamma", "learning_rate", "batch_size", "policy", "policy_kwargs", "n_timesteps", "env_kwargs", "seed", "device"]
    known += ["dataset", "examples", "episodes", "verbose", "gradient_steps", "unknown", "policy", "n_timesteps"]
    lines = ["default:", "  policy: MlpPolicy", "  n_timesteps: 4"]
    if rng.random() < 0.1:
        lines = [VALUES[rng.integers(len(VALUES))]]
    for _ in range(rng.integers(0, 4)):
        lines.append(f"  {known[rng.integers(len(known))]}: {VALUES[rng.integers(len(VALUES))]}")
    text = "\n".join(lines)
    if rng.random() < 0.2:
        place = int(rng.integers(len(text) + 1))
        letters = ["\t", "\0", ":", "- ", "[", "\x1b", "\n\n", "é"]
        text = text[:place] + letters[rng.integers(len(letters))] + text[place:]
    return text


def configs(rng, folder):
    """Config files: a model is made of what they say, or they are refused."""
    path = folder / "config.yml"
    path.write_text(random_yaml(rng), encoding="utf-8", errors="replace")
    config = load_config(os.fspath(path), "Pendulum-v1")
    config.pop("dataset", None)
    create_model("bc", {**CONFIG, **config}, dataset=str(folder / "states.h5"))
    return "right"


def grids(rng, folder):
    """Grid files."""
    whole = {"env": "E-v0", "methods": {"bc": {"algo": "bc", "config": "bc"}}, "tasks": ["a"], "seeds": [0], "n_timesteps": 20}
    whole["dataset"] = "d.h5"
    text = yaml.safe_dump(whole)
    keys = [*whole, "examples", "env_kwargs", "checkpoints", "episodes", "save_freq", "extra"]
    lines = [line for line in text.splitlines()]
    for _ in range(rng.integers(1, 3)):
        key = keys[rng.integers(len(keys))]
        lines = [line for line in lines if not line.startswith(f"{key}:")] if rng.random() < 0.8 else lines
        lines.append(f"{key}: {VALUES[rng.integers(len(VALUES))]}")
    path = folder / "grid.yml"
    path.write_text("\n".join(lines), encoding="utf-8")
    grid = load_grid(os.fspath(path))
    for run in plan(grid, folder / "runs").values():
        assert run.folder.resolve().is_relative_to((folder / "runs").resolve())
    return "right"


KINDS = {
    "bytes": (damaged_bytes, (DatasetError,)),
    "structure": (damaged_structure, (DatasetError,)),
    "arguments": (arguments, (DatasetError,)),
    # The command line turns these into one line
    "configs": (configs, (RuntimeError, ValueError)),
    "grids": (grids, (RuntimeError,)),
}


def outcome(kind, number, folder):
    """:return: what became of an input"""
    work, allowed = KINDS[kind]
    rng = np.random.default_rng([SEED, [*KINDS].index(kind), number])
    try:
        return work(rng, folder)
    except allowed as error:
        return f"refused: {' '.join(str(error).split())[:150]}"
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        return f"WRONG: {type(error).__name__} at {where.filename}:{where.lineno}: {' '.join(str(error).split())[:200]}"


def main(folder, *batches):
    th.set_num_threads(1)
    warnings.simplefilter("ignore")
    folder = Path(folder)
    if not (folder / "run/model.zip").exists():
        with contextlib.redirect_stdout(io.StringIO()):
            prepare(folder)
    load_run(folder / "run/model.zip")
    for batch in batches:
        kind, first, last = batch.split(":")
        for number in range(int(first), int(last)):
            if hasattr(signal, "setitimer"):
                signal.setitimer(signal.ITIMER_PROF, SECONDS)
            print(f"{kind}:{number}", end=" ", flush=True)
            with open(os.devnull, "w") as nowhere, contextlib.redirect_stderr(nowhere):
                text = outcome(kind, number, folder)
            print(text.encode("ascii", "backslashreplace").decode(), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
