"""The Python blocks of README.md and docs/ run as they stand, all of a page in order, on small data and budgets."""

import functools
import inspect
import re
import shutil
import textwrap
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from format_files import write_aloha, write_maniskill, write_robomimic
from PIL import Image
from stable_baselines3 import SAC
from stable_baselines3.common import callbacks, evaluation

pytest.importorskip("metaworld")

import sb3_offline.evaluation
import sb3_offline.experiment.evaluation
from sb3_offline import ORIL, OfflineAlgorithm
from sb3_offline.ceborl import DiagnosticsCallback, backups
from sb3_offline.cli import main
from sb3_offline.common.example_based import ExampleBasedAlgorithm
from sb3_offline.data.convert import convert
from sb3_offline.data.examples import load_examples
from sb3_offline.data.reader import OfflineDataset
from sb3_offline.data.writer import DatasetWriter
from sb3_offline.data_tools import SAMPLES

ROOT = Path(__file__).resolve().parent.parent
BLOCK = re.compile(r"^( *)```python\n(.*?)^\1```$", re.MULTILINE | re.DOTALL)

#: What pages read and their Python blocks do not make, as they name it, and which of `stand_ins` is put there
FILES = {
    "mixed.h5": "states.h5",
    "data/mixed.h5": "states.h5",
    "examples.h5": "drawer_examples.h5",
    "data/door_examples.h5": "door_examples.h5",
    "data/pixels.h5": "pixels.h5",
    "data/drawer_examples.h5": "drawer_frames.h5",
    "data/*.h5": "pixels.h5",
    "episodes.h5": "pixels.h5",
    "images_of_success/": "images",
    "data/robot.h5": "robot.h5",
    "rollouts.npz": "rollouts.npz",
    "lift.hdf5": "robomimic.hdf5",
    "aloha_sim_insertion/": "aloha",
    "trajectory.h5": "maniskill.h5",
}

#: Code before a page's blocks, for what it leaves to the reader or to another page
PRELUDES = {
    "docs/dataset_format.md": """
import gymnasium, numpy
env = gymnasium.make("Pendulum-v1")
observations, actions, rewards = numpy.zeros((9, 3)), numpy.zeros((8, 1)), numpy.zeros(8)
""",
    "docs/guide/without_environment.md": """
import stable_baselines3
stable_baselines3.SAC("MlpPolicy", "Pendulum-v1").learn(3000).save_replay_buffer("pendulum.pkl")
""",
}

#: Numbers by which these arguments are divided, so that a thousand gradient steps are one
BUDGETS = [
    (OfflineAlgorithm, "__init__", {"batch_size": 16}),
    (ExampleBasedAlgorithm, "__init__", {"example_batch_size": 16}),
    (ORIL, "__init__", {"reward_steps": 1000}),
    (OfflineAlgorithm, "learn", {"total_timesteps": 1000, "log_interval": 1000}),
    (SAC, "learn", {"total_timesteps": 50}),  # its first 100 steps are random: 10,000 still learn
    (evaluation, "evaluate_policy", {"n_eval_episodes": 20}),
    (sb3_offline.experiment.evaluation, "evaluate_success", {"n_episodes": 20}),
    (sb3_offline.evaluation, "fitted_q_evaluation", {"n_steps": 1000}),
    (sb3_offline.evaluation.OfflineEvalCallback, "__init__", {"eval_freq": 1000}),
    (DiagnosticsCallback, "__init__", {"check_freq": 1000}),
    (callbacks.EvalCallback, "__init__", {"eval_freq": 1000, "n_eval_episodes": 20}),
    (callbacks.CheckpointCallback, "__init__", {"save_freq": 1000}),
]


def python_blocks(path):
    """:return: the code of each block, after as many empty lines as put it where it stands in the file"""
    text = path.read_text(encoding="utf-8")
    return ["\n" * text.count("\n", 0, block.start(2)) + textwrap.dedent(block[2]) for block in BLOCK.finditer(text)]


BLOCKS = {
    path.relative_to(ROOT).as_posix(): python_blocks(path)
    for path in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    if "_build" not in path.parts
}


def divide(function, divisors):
    """:return: the function, called with these arguments divided, but no less than 1; None stays"""
    signature = inspect.signature(function)

    @functools.wraps(function)
    def divided(*args, **kwargs):
        call = signature.bind(*args, **kwargs)
        call.apply_defaults()
        for name, divisor in divisors.items():
            if call.arguments[name] is not None:
                call.arguments[name] = max(call.arguments[name] // divisor, 1)
        return function(*call.args, **call.kwargs)

    return divided


@pytest.fixture(scope="module")
def stand_ins(tmp_path_factory):
    """A folder of small files, most of them out of the data that are shipped."""
    folder = tmp_path_factory.mktemp("stand_ins")
    states = OfflineDataset(SAMPLES / "sac_states.h5")
    # Several times over, since a page holds out a hundred episodes
    convert(states.select(np.tile(np.arange(states.n_episodes), 6)), folder / "states.h5", progress_bar=False)
    shutil.copy(SAMPLES / "sac_pixels.h5", folder / "pixels.h5")
    for name, dataset, task in (
        ("door_examples.h5", "states.h5", "door-open"),
        ("drawer_examples.h5", "states.h5", "drawer-open"),
        ("drawer_frames.h5", "pixels.h5", "drawer-open"),
    ):
        main(["examples", str(folder / dataset), "--source", task, "-n", "10", "-o", str(folder / name)])
    (folder / "images").mkdir()
    space = OfflineDataset(folder / "pixels.h5").observation_space
    for number, frame in enumerate(load_examples(folder / "drawer_frames.h5", space)):
        Image.fromarray(frame).save(folder / f"images/{number}.png")
    write_robot(folder / "robot.h5", OfflineDataset(folder / "pixels.h5"))
    # Two episodes of Pendulum-v1 as imitation writes them
    rollouts = {"obs": np.zeros((402, 3)), "acts": np.zeros((400, 1)), "rews": np.zeros(400), "terminal": np.ones(2, bool)}
    np.savez(folder / "rollouts.npz", indices=[200], **rollouts)
    write_robomimic(folder / "robomimic.hdf5", image_shape=(84, 84, 3))
    write_aloha(folder / "aloha", joints=14)
    write_maniskill(folder / "maniskill.h5")
    return folder


def write_robot(path, pixels):
    """The same episodes as images and states of the hand, a part of the state that lacks its first row in the file."""
    env = gym.make("MultimodalMetaworld-v0", obs_type="both")
    with DatasetWriter(path, env.observation_space, env.action_space, rewards=False, success=False) as writer:
        for episode in range(pixels.n_episodes):
            row, step, n = pixels.observation_starts[episode], pixels.step_starts[episode], pixels.lengths[episode]
            hand = np.asarray(pixels.extras["state"][step : step + n])[:, :4]
            image = np.asarray(pixels.observations[row : row + n + 1])
            writer.add_episode({"hand": np.vstack([hand[:1], hand]), "image": image}, pixels.actions[step : step + n])


@pytest.mark.parametrize("page", [page for page, blocks in BLOCKS.items() if blocks])
def test_python_blocks_run(page, stand_ins, tmp_path, monkeypatch):
    if any("import rl_zoo3" in block for block in BLOCKS[page]):
        pytest.importorskip("rl_zoo3")
    for name, stand_in in FILES.items():
        if any(f'"{name}"' in block for block in BLOCKS[page]):
            path = tmp_path / name.replace("*", "all")
            path.parent.mkdir(exist_ok=True)
            path.symlink_to(stand_ins / stand_in)
    monkeypatch.chdir(tmp_path)
    for owner, name, divisors in BUDGETS:
        monkeypatch.setattr(owner, name, divide(getattr(owner, name), divisors))
    monkeypatch.setattr(backups, "DETECTOR_PASSES", 0)
    namespace = {"__name__": "__main__"}  # as in a script: functions that it defines are saved with a model, by value
    exec(PRELUDES.get(page, ""), namespace)
    for block in BLOCKS[page]:
        exec(compile(block, ROOT / page, "exec"), namespace)
