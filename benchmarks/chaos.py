"""
Kill, fill and collide everything that writes, and count what is lost.

    python benchmarks/chaos.py -o results/chaos.csv [--folder /dev/shm] [--jobs 4] [--kills 1000] [--meetings 1000]

Each row of the table is one kind of trouble. A lost episode is one for which `add_episode` had returned and which is not
there afterwards; a damaged file is one that does not open, or whose episodes do not match their checksums. Processes are
killed with SIGKILL; the machine itself is not.
"""

import argparse
import csv
import multiprocessing
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_offline.data.check import check_dataset
from sb3_offline.data.convert import convert
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.examples import save_examples
from sb3_offline.data.files import replacing
from sb3_offline.data.reader import OfflineDataset
from sb3_offline.data.writer import DatasetWriter
from sb3_offline.experiment.run import TrainingRun, locked_run
from sb3_offline.experiment.training import load_run, train_run

FIELDS = ("trouble", "rounds", "lost", "damaged", "remark")
STATES, ACTIONS = spaces.Box(-np.inf, np.inf, (3,), np.float32), spaces.Box(-1, 1, (2,), np.float32)
# Everything is imported once. Shared values have no lock, since a killed process would keep it
FORK = multiprocessing.get_context("fork")


class Rounds:
    """
    Counts rounds until there are enough of them, or until the time is over.

    :param wanted: number of rounds
    :param until: time of ``time.monotonic``
    """

    def __init__(self, wanted: int, until: float):
        self.wanted, self.until, self.done = wanted, until, 0

    def left(self) -> bool:
        """:return: whether there is another round"""
        return self.done < self.wanted and time.monotonic() < self.until

    def __iter__(self) -> Iterator[int]:
        while self.left():
            self.done += 1
            yield self.done - 1


#: Numbers of lost episodes and of damaged files, and other counts
Outcome: TypeAlias = tuple[int, int, dict[str, int]]


def episode(index: int) -> dict[str, Any]:
    """:return: arguments of ``add_episode``, the same for the same index"""
    rng = np.random.default_rng(index)
    n = int(rng.integers(1, 13))
    rows = rng.normal(size=(n + 1, 3)).astype(np.float32)
    return {"observations": rows, "actions": rng.uniform(-1, 1, (n, 2)), "rewards": rng.normal(size=n), "seed": index}


def writer(path: Path, mode: str = "a", room: int = 3) -> DatasetWriter:
    """:return: a writer whose file outgrows its room again and again"""
    return DatasetWriter(path, STATES, ACTIONS, mode=mode, success=False, capacity=(room, 10 * room))  # type: ignore[arg-type]


def losses(path: Path, n_acknowledged: int) -> tuple[int, int]:
    """:return: the numbers of lost episodes, and of damaged files (0 or 1)"""
    if not path.exists():
        return n_acknowledged, 0
    verdict = check_dataset(path)
    if verdict.damages:
        print(f"DAMAGED: {verdict.damages}", flush=True)
        return 0, 1
    seeds = OfflineDataset(path).seeds
    is_right = np.array_equal(seeds, np.arange(len(seeds)))
    return max(n_acknowledged - len(seeds), 0), int(not is_right)


def in_child(function: Callable[..., Any], *args: Any) -> Any:
    """:return: a process that has started"""
    process = FORK.Process(target=_quietly, args=(function, *args), daemon=True)
    process.start()
    return process


def _quietly(function: Callable[..., Any], *args: Any) -> None:
    th.set_num_threads(1)
    warnings.simplefilter("ignore")
    try:
        function(*args)
    except (DatasetError, OSError, RuntimeError) as error:
        if os.environ.get("CHAOS_VERBOSE"):
            print(f"{function.__name__}: {error}", file=sys.stderr)
        os._exit(1)
    os._exit(0)


def write_on(path: Path, counter: Any, n: int | None = None) -> None:
    """Append episodes, for ever or ``n`` of them. The counter holds the number of those that are acknowledged."""
    while True:
        try:
            opened = writer(path)
            break
        except DatasetError:  # another process has it
            time.sleep(0.001)
    with opened:
        while n is None or opened.n_episodes < n:
            opened.add_episode(**episode(opened.n_episodes))
            counter.value = opened.n_episodes


def kills_of_the_writer(folder: Path, rounds: Rounds, rng: random.Random) -> Outcome:
    """A process that appends episodes is killed at a random moment, and the next one goes on with its file."""
    path, counter = folder / "d.h5", FORK.RawValue("q", 0)
    lost = damaged = n_while_writing = 0
    for number in rounds:
        if number % 20 == 0:
            path.unlink(missing_ok=True)
            counter.value = 0
        before = counter.value
        process = in_child(write_on, path, counter)
        while process.is_alive() and counter.value == before and rng.random() < 0.999:  # some are killed before they write
            time.sleep(0.0005)
        time.sleep(rng.uniform(0, 0.01))
        process.kill()
        process.join()
        n_while_writing += counter.value > before
        new = losses(path, counter.value)
        lost, damaged = lost + new[0], damaged + new[1]
    return lost, damaged, {"kills after the first episode of a process": n_while_writing}


def ask(place: Callable[[], Path], stop: Any) -> None:
    """Ask for the right to write, again and again."""
    while not stop.value:
        try:
            writer(place()).close()
        except (DatasetError, FileNotFoundError):  # the second, where a round ends meanwhile and removes its file
            pass
        time.sleep(0.001)  # leaves the writer a part of the processor


def convert_it(place: Callable[[], Path], stop: Any) -> None:
    """Convert a file in its place, again and again."""
    while not stop.value:
        try:
            path = place()
            convert(path, path, overwrite=True, progress_bar=False)
        except DatasetError:
            pass
        time.sleep(0.001)


def read_it(place: Callable[[], Path], stop: Any, wrong: Any) -> None:
    """Read a file that is being written. Only a file that is not there may be refused, or one that was replaced."""
    while not stop.value:
        try:
            seeds = OfflineDataset(place()).seeds
            wrong.value += not np.array_equal(seeds, np.arange(len(seeds)))
        except DatasetError as error:
            if "does not exist" not in str(error) and "was replaced" not in str(error):
                print(f"WRONG: {error}", flush=True)
                wrong.value += 1
        time.sleep(0.001)


def meetings(folder: Path, rounds: Rounds, rng: random.Random) -> Outcome:
    """A writer, a second writer, a converter in place and a reader meet at one file in each round."""
    current, counter, wrong, stop = (FORK.RawValue("q", 0) for _ in range(4))

    def place() -> Path:
        return folder / f"m{current.value}.h5"

    others = [in_child(ask, place, stop), in_child(convert_it, place, stop), in_child(read_it, place, stop, wrong)]
    lost = damaged = disturbed = 0
    for number in rounds:
        current.value, counter.value = number, 0
        path = place()
        try:
            write_on(path, counter, 4)
        except (DatasetError, OSError, RuntimeError) as error:
            print(f"DISTURBED: {error}", flush=True)
            disturbed += 1
        new = losses(path, counter.value)
        lost, damaged = lost + new[0], damaged + new[1]
        path.unlink(missing_ok=True)
    stop.value = 1
    for process in others:
        process.join()
    died = sum(process.exitcode != 0 for process in others)
    return lost, damaged + wrong.value, {"writers that were disturbed": disturbed, "others that failed": died}


def two_converts(folder: Path, rounds: Rounds, rng: random.Random) -> Outcome:
    """Two conversions write one file at the same time; one of them is killed in half of the rounds."""
    source, target = folder / "s.h5", folder / "t.h5"
    with writer(source, "w", 100) as opened:
        for index in range(60):
            opened.add_episode(**episode(index))

    def work() -> None:
        convert(source, target, rng.choice(["contiguous", "compressed"]), overwrite=True, progress_bar=False)

    lost = damaged = 0
    convert(source, target, progress_bar=False)
    for number in rounds:
        processes = [in_child(work), in_child(work)]
        if number % 2:
            time.sleep(rng.uniform(0, 0.03))
            processes[0].kill()
        for process in processes:
            process.join()
        new = losses(target, 60)
        lost, damaged = lost + new[0], damaged + new[1]
    return lost, damaged, {}


def kills_of_training(folder: Path, rounds: Rounds, rng: random.Random) -> Outcome:
    """A training run is killed at random moments and goes on until it ends. Its model is compared with that of a whole run."""
    data = folder / "train.h5"
    with writer(data, "w", 100) as opened:
        for index in range(40):
            opened.add_episode(**episode(index))
    config = {"policy": "MlpPolicy", "policy_kwargs": {"net_arch": [16]}, "batch_size": 16, "n_timesteps": 60}

    def run_in(name: str) -> TrainingRun:
        return TrainingRun("bc", "Pendulum-v1", config, folder / name, dataset=str(data), save_freq=5)

    def work(name: str) -> None:
        train_run(run_in(name), progress_bar=False)

    def parameters(name: str) -> list[np.ndarray]:
        return [value.detach().numpy() for value in load_run(folder / name / "model.zip")[0].policy.parameters()]

    process = in_child(work, "whole")
    began = time.monotonic()
    process.join()
    duration = time.monotonic() - began
    n_runs = n_different = 0
    while rounds.left():
        name, n_runs = f"run{n_runs}", n_runs + 1
        for number in range(1000):
            process = in_child(work, name)
            process.join(rng.uniform(0, duration) if number < 6 else None)
            if process.exitcode is not None:
                break
            process.kill()
            process.join()
            rounds.done += 1
        same = [np.array_equal(*pair) for pair in zip(parameters("whole"), parameters(name), strict=True)]
        n_different += not all(same)
        shutil.rmtree(folder / name)
    return n_different, 0, {"runs that went on to their end": n_runs, "of these with other bits": n_different}


def full_disks(folder: Path, rounds: Rounds, rng: random.Random) -> Outcome:
    """The disk fills up while episodes are written; then there is room again, and the writer goes on."""
    place, lost, damaged, n_full = folder / "small", 0, 0, 0
    counter = FORK.RawValue("q", 0)
    for _ in rounds:
        place.mkdir()
        subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={rng.randint(100, 400)}k", "none", place], check=True)
        try:
            counter.value = 0
            process = in_child(write_on, place / "d.h5", counter, 2000)
            process.join()
            n_full += process.exitcode != 0
            new = losses(place / "d.h5", counter.value)
            subprocess.run(["mount", "-o", "remount,size=20m", place], check=True)
            process = in_child(write_on, place / "d.h5", counter, counter.value + 5)
            process.join()
            after = losses(place / "d.h5", counter.value)
            lost, damaged = lost + new[0] + after[0], damaged + max(new[1], after[1])
        finally:
            subprocess.run(["umount", place], check=True)
            place.rmdir()
    return lost, damaged, {"writers that met the full disk": n_full}


def read_only_folders(folder: Path, rounds: Rounds, rng: random.Random) -> Outcome:
    """Everything that writes is asked to write to a folder that cannot be written to."""
    place, damaged, n_refused = folder / "fixed", 0, 0
    place.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=4m", "none", place], check=True)
    path = place / "d.h5"
    try:
        with writer(path, "w") as opened:
            for index in range(5):
                opened.add_episode(**episode(index))
        subprocess.run(["mount", "-o", "remount,ro", place], check=True)
        attempts: list[Callable[[], Any]] = [
            lambda: writer(path),
            lambda: writer(place / "new.h5", "w"),
            lambda: convert(path, place / "c.h5", progress_bar=False),
            lambda: save_examples(place / "e.h5", np.zeros((3, 3), np.float32), STATES),
            lambda: replacing(place / "text").__enter__(),
            lambda: locked_run(place / "run").__enter__(),
        ]
        for number in rounds:
            try:
                attempts[number % len(attempts)]()
                damaged += 1
            except DatasetError as error:
                n_refused += "\n" not in str(error)
            damaged += sum(losses(path, 5)) + (os.listdir(place) != ["d.h5"])
    finally:
        subprocess.run(["umount", place], check=True)
    return 0, damaged, {"attempts refused in one line": n_refused}


def in_jobs(
    work: Callable[..., Outcome], wanted: int, jobs: int, args: argparse.Namespace
) -> tuple[int, int, int, dict[str, int]]:
    """:return: the sums over several processes, in a folder of its own each: rounds, lost, damaged, and other counts"""
    until = time.monotonic() + 60 * args.minutes
    receivers = []
    for job in range(jobs):
        receiver, sender = FORK.Pipe(duplex=False)
        rounds = Rounds(wanted // jobs + (job < wanted % jobs), until)
        FORK.Process(target=_job, args=(work, rounds, args.folder, args.seed + job, sender)).start()
        sender.close()
        receivers.append(receiver)
    parts = [receiver.recv() for receiver in receivers]
    done, lost, damaged = (sum(part[index] for part in parts) for index in range(3))
    return done, lost, damaged, {name: sum(part[3][name] for part in parts) for name in parts[0][3]}


def _job(work: Callable[..., Outcome], rounds: Rounds, folder: Path | None, seed: int, sender: Any) -> None:
    th.set_num_threads(1)
    with tempfile.TemporaryDirectory(dir=folder) as own:
        lost, damaged, counts = work(Path(own), rounds, random.Random(seed))
    sender.send((rounds.done, lost, damaged, counts))


def main() -> None:
    """Run all rows and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, help="CSV file to write")
    parser.add_argument("--folder", type=Path, help="folder to work in (default: that for temporary files)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2, help="number of processes that share the rounds (default: 2)")
    parser.add_argument("--minutes", type=float, default=60, help="end each kind of trouble after this time (default: 60)")
    for name, rounds in (
        ("kills", 1000),
        ("meetings", 1000),
        ("converts", 200),
        ("trainings", 40),
        ("disks", 40),
        ("fixed", 60),
    ):
        parser.add_argument(f"--{name}", type=int, default=rounds, help=f"number of rounds (default: {rounds})")
    args = parser.parse_args()
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    troubles: list[tuple[str, Callable[..., Outcome], int, bool]] = [
        ("a process that writes a dataset is killed", kills_of_the_writer, args.kills, False),
        ("two writers, a converter and a reader meet at one file", meetings, args.meetings, False),
        ("two conversions write one file, one of them killed", two_converts, args.converts, False),
        ("a training run is killed and goes on", kills_of_training, args.trainings, False),
        ("the disk fills up", full_disks, args.disks, True),
        ("the folder is read-only", read_only_folders, args.fixed, True),
    ]
    rows = []
    for trouble, work, rounds, mounts in troubles:
        if mounts and (not sys.platform.startswith("linux") or os.geteuid() != 0):
            print(f"{trouble}: left out, since only root may mount a small disk", flush=True)
            continue
        if not rounds:
            continue
        began = time.monotonic()
        done, lost, damaged, counts = in_jobs(work, rounds, 1 if mounts else args.jobs, args)
        remark = "; ".join(f"{name}: {count}" for name, count in counts.items())
        rows.append(dict(zip(FIELDS, (trouble, done, lost, damaged, remark), strict=True)))
        seconds = time.monotonic() - began
        print(f"{trouble}: {done} rounds, {lost} lost, {damaged} damaged; {remark} ({seconds:.0f} s)", flush=True)
        if args.output:
            with replacing(args.output) as temporary, temporary.open("w", newline="") as file:
                table = csv.DictWriter(file, FIELDS, lineterminator="\n")
                table.writeheader()
                table.writerows(rows)
    if any(row["lost"] or row["damaged"] for row in rows):
        sys.exit("Something was lost or damaged")


if __name__ == "__main__":
    main()
