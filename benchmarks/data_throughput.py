"""
What the data cost: sampling, memory, opening, converting, growth of a dataset; and what a decision of the environment costs.

    python benchmarks/data_throughput.py --scratch /tmp

Writes made-up datasets of frames of 64x64x3 into a folder that is removed at the end (the largest, of 1,000,000 frames, takes
12.3 GB), and adds its entries to results/throughput.json and a figure to docs/images. Leave the machine alone meanwhile.
"""

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from throughput import ACTIONS, BATCH_SIZE, OBSERVATIONS, RESULTS, interleave, merge, one_step, ours, write_transitions

from sb3_offline.common.augmentation import random_shift
from sb3_offline.common.process import prepare_process
from sb3_offline.data.buffer import OfflineReplayBuffer
from sb3_offline.data.convert import convert
from sb3_offline.data.reader import OfflineDataset
from sb3_offline.data.writer import DatasetWriter
from sb3_offline.envs import ENV_ID

EPISODE_LENGTH = 50
FRAMES = OBSERVATIONS["pixels"]
FRAME_BYTES = int(np.prod(FRAMES.shape))
GROWTH = (10_000, 100_000, 375_000, 1_000_000)
FIGURE = Path("docs/images/growth.png")


def write_frames(path: Path, n_frames: int, **kwargs: Any) -> None:
    """Episodes of noise on a few colours, so that compression has something to find."""
    rng = np.random.default_rng(0)
    n_episodes = n_frames // (EPISODE_LENGTH + 1)
    palette = rng.integers(0, 256, (16, 3), np.uint8)
    shape = (EPISODE_LENGTH + 1, *FRAMES.shape[:2])
    library = [palette[rng.integers(0, 16, shape) * (rng.random(shape) < 0.1)] for _ in range(8)]
    capacity = (n_episodes, n_episodes * EPISODE_LENGTH)
    with DatasetWriter(path, FRAMES, ACTIONS, success=False, rewards=False, capacity=capacity, mode="w", **kwargs) as writer:
        for index in range(n_episodes):
            writer.add_episode(library[index % 8], rng.uniform(-1, 1, (EPISODE_LENGTH, 4)).astype(np.float32))


def milliseconds(function: Any, repeats: int) -> list[float]:
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        function()
        times.append(1e3 * (time.perf_counter() - began))
    return times


def sampling(path: Path, storage: str) -> list[float]:
    """Milliseconds of a batch of s, s' and s of ten steps later, all shifted."""
    buffer = OfflineReplayBuffer(str(path), _channel_first(), ACTIONS, "cpu", n_steps=10, storage=storage, seed=0)  # type: ignore

    def step() -> None:
        batch = buffer.sample(BATCH_SIZE)
        for images in (batch.observations, *(horizon.observations for horizon in batch.horizons)):
            random_shift(images, 4, buffer.rng)  # type: ignore[arg-type]

    step()
    return milliseconds(step, 40)


def _channel_first() -> gym.spaces.Box:
    height, width, channels = FRAMES.shape
    return gym.spaces.Box(0, 255, (channels, height, width), np.uint8)


def in_child(code: str, *arguments: Any, data_limit: int | None = None) -> Any:
    """Run a function of this file in a process of its own, with so many bytes of memory of its own at most."""

    def limit() -> None:
        if data_limit is not None:
            resource.setrlimit(resource.RLIMIT_DATA, (data_limit, data_limit))

    command = [sys.executable, __file__, "--child", code, *map(str, arguments)]
    output = subprocess.run(command, check=True, capture_output=True, text=True, preexec_fn=limit).stdout
    return json.loads(output.strip().splitlines()[-1])


def child_memory(path: str) -> dict[str, float]:
    """Memory that a buffer takes beyond what the imports take."""
    before = _resident_bytes()
    buffer = OfflineReplayBuffer(path, _channel_first(), ACTIONS, "cpu", n_steps=10, storage="memory", seed=0)
    for _ in range(20):
        buffer.sample(BATCH_SIZE)
    return {"bytes": _resident_bytes() - before, "raw": len(OfflineDataset(path).observations) * FRAME_BYTES}


def child_mapped_sampling(path: str) -> dict[str, Any]:
    return {"ms": sampling(Path(path), "mmap")}


def _resident_bytes() -> int:
    """:return: memory of this process's own; pages of mapped files are the system's, which takes them back when it likes"""
    with open("/proc/self/status") as file:
        return 1024 * int(next(line for line in file if line.startswith("RssAnon")).split()[1])


def forget_pages(path: Path) -> None:
    """Have the next reads come from the disk."""
    with path.open("rb") as file:
        os.fsync(file.fileno())
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def data_entries(folder: Path, step_ms: float) -> list[dict[str, Any]]:
    entries: list[dict[str, Any]] = []
    large, small, packed = (folder / f"{name}.h5" for name in ("large", "small", "packed"))
    write_frames(large, 375_000)
    size = large.stat().st_size
    forget_pages(large)
    opening = milliseconds(lambda: OfflineReplayBuffer(str(large), _channel_first(), ACTIONS, "cpu", storage="mmap"), 1)[0]
    entries.append({"name": "open_mapped_375000_frames", "ours_ms": round(opening, 1), "gigabytes": round(size / 1e9, 2)})

    write_frames(small, 60_000)
    for name, times in (
        ("memory", sampling(small, "memory")),
        ("mapped", sampling(large, "mmap")),
        # PyTorch alone takes more than a gigabyte of address space for data
        ("mapped_in_2_GB", in_child("child_mapped_sampling", large, data_limit=2 << 30)["ms"]),
    ):
        median, low, high = np.quantile(times, (0.5, 0.25, 0.75))
        entry = {"name": f"sample_256_shifted_windows_{name}", "ours_ms": round(median, 2)}
        entries.append(
            {**entry, "ours_ms_quartiles": [round(low, 2), round(high, 2)], "share_of_step": round(median / step_ms, 3)}
        )
    memory = in_child("child_memory", small)
    entries.append(
        {"name": "memory_over_raw_frames", "ratio": round(memory["bytes"] / memory["raw"], 3), "raw_bytes": memory["raw"]}
    )

    convert(small, packed, storage="compressed")
    unpacked, copied = folder / "unpacked.h5", folder / "copied.h5"
    forget_pages(packed)
    conversion = milliseconds(lambda: (convert(packed, unpacked, storage="contiguous"), forget_pages(unpacked)), 1)[0]
    copy = milliseconds(lambda: (shutil.copyfile(unpacked, copied), forget_pages(copied)), 1)[0]
    entries.append(
        {
            "name": "convert_compressed_to_contiguous",
            "ours_ms": round(conversion),
            "peer": "copying the contiguous file",
            "peer_ms": round(copy),
            "ratio": round(copy / conversion, 2),
            "megabytes_per_second": round(unpacked.stat().st_size / 1e3 / conversion),
        }
    )
    return entries


def growth_entries(folder: Path, sizes: tuple[int, ...], seconds: float) -> list[dict[str, Any]]:
    """Steps of CEBORL: with more and more frames (mapped), a larger batch, and more sampled actions."""
    entries: list[dict[str, Any]] = []
    for size in sizes:
        path = folder / "growing.h5"
        write_frames(path, size)
        step = one_step(ours("ceborl", "pixels", path, True, dataset_storage="mmap"))
        times = interleave({"step": step}, 2, seconds)["step"]
        entries.append({"name": "growth_frames", "frames": size, "ours_ms": round(float(np.median(np.concatenate(times))), 1)})
        path.unlink()
    path = folder / "states.h5"
    write_transitions(path, OBSERVATIONS["states"])
    for k in (1, 4, 8, 16, 32, 64):
        step = one_step(ours("ceborl", "states", path, False, n_action_samples=k))
        times = interleave({"step": step}, 2, seconds)["step"]
        entries.append({"name": "growth_action_samples", "k": k, "ours_ms": round(float(np.median(np.concatenate(times))), 2)})
    for batch_size in (64, 128, 256, 512, 1024):
        step = one_step(ours("ceborl", "states", path, False), batch_size)
        times = interleave({"step": step}, 2, seconds)["step"]
        entries.append(
            {"name": "growth_batch", "batch": batch_size, "ours_ms": round(float(np.median(np.concatenate(times))), 2)}
        )
    return entries


def environment_entries() -> list[dict[str, Any]]:
    entries: list[dict[str, Any]] = []
    for obs_type in ("state", "pixels"):
        began = time.process_time()
        env = gym.make(ENV_ID, obs_type=obs_type)
        env.reset(seed=0)
        entries.append({"name": f"environment_{obs_type}_first_reset", "ours_ms": round(1e3 * (time.process_time() - began))})
        env.action_space.seed(0)
        began = time.process_time()
        for _ in range(300):
            if env.step(env.action_space.sample())[3]:
                env.reset()
        entries.append(
            {"name": f"environment_{obs_type}_decision", "ours_ms": round(1e3 * (time.process_time() - began) / 300, 2)}
        )
        env.close()
    return entries


def draw(entries: list[dict[str, Any]], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(9, 2.8))
    panels = (
        ("growth_frames", "frames", "frames in the dataset (pictures)"),
        ("growth_action_samples", "k", "sampled actions K"),
    )
    for axis, (name, key, label) in zip(axes, (*panels, ("growth_batch", "batch", "batch size (K = 16)")), strict=True):
        points = [(entry[key], entry["ours_ms"]) for entry in entries if entry["name"] == name]
        axis.plot(*zip(*points, strict=True), "o-")
        axis.set_xlabel(label + (", states" if name != "growth_frames" else ""))
        axis.set_ylim(bottom=0)
    axes[0].set_xscale("log")
    axes[0].set_ylabel("ms a step")
    figure.tight_layout()
    figure.savefig(path, dpi=120)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scratch", type=Path, default=Path(tempfile.gettempdir()), help="18 GB are needed there")
    parser.add_argument("--sizes", nargs="+", type=int, default=list(GROWTH))
    parser.add_argument("--seconds", type=float, default=2.0)
    parser.add_argument("--output", type=Path, default=RESULTS)
    parser.add_argument("--child", nargs="+", help=argparse.SUPPRESS)
    args = parser.parse_args()
    prepare_process()
    if args.child:
        print(json.dumps(globals()[args.child[0]](*args.child[1:])))
        return
    steps = {entry["name"]: entry for entry in json.loads(args.output.read_text())} if args.output.exists() else {}
    step_ms = steps.get("ceborl_pixels_vs_sb3_sac_bf16", {}).get("ours_ms", float("nan"))
    th.manual_seed(0)
    with tempfile.TemporaryDirectory(dir=args.scratch) as name:
        entries = (
            environment_entries()
            + data_entries(Path(name), step_ms)
            + growth_entries(Path(name), tuple(args.sizes), args.seconds)
        )
    merged = merge(args.output, entries)
    if args.output == RESULTS:
        draw(merged, FIGURE)
    for entry in entries:
        print(json.dumps(entry))


if __name__ == "__main__":
    main()
