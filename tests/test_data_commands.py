"""What the commands about data say of spaces that files do not declare, of other environments, and of examples."""

import gymnasium as gym
import h5py
import numpy as np
import pytest
from data_files import ACTIONS, STATES, write_dataset
from gymnasium import spaces

from sb3_offline import cli
from sb3_offline.data.reader import OfflineDataset
from sb3_offline.data.writer import DatasetWriter


class Arm(gym.Env):
    def __init__(self, observation_space=STATES, action_space=ACTIONS):
        self.observation_space, self.action_space = observation_space, action_space


gym.register("TestArm-v0", Arm, max_episode_steps=20)
gym.register("TestOtherArm-v0", lambda: Arm(spaces.Box(-1, 1, (4,)), spaces.Box(-1, 1, (2,))), max_episode_steps=3)


def test_bounds_of_actions_are_given_to_convert(tmp_path, capsys):
    rng = np.random.default_rng(0)
    arrays = {"observations": rng.normal(size=(9, 3)), "actions": rng.uniform(-3, 3, (9, 2)), "rewards": np.zeros(9)}
    source, target = str(tmp_path / "a.hdf5"), str(tmp_path / "a.h5")
    with h5py.File(source, "w") as file:
        for name, array in {"terminals": np.arange(9) == 8, "timeouts": np.zeros(9, bool), **arrays}.items():
            file[name] = array
    with pytest.raises(SystemExit, match="--action-low and --action-high"):
        cli.main(["convert", source, target])
    with pytest.raises(SystemExit, match="--action-low has 2 numbers, and --action-high 1; give both"):
        cli.main(["convert", source, target, "--action-low", "-3", "-3", "--action-high", "3"])
    cli.main(["convert", source, target, "--action-low", "-3", "-4", "--action-high", "3", "4.5"])
    assert OfflineDataset(target).action_space == spaces.Box(np.float32([-3, -4]), np.float32([3, 4.5]))


def test_inspect_compares_with_an_environment(tmp_path, capsys):
    write_dataset(tmp_path / "a.h5", 6, STATES)
    cli.main(["inspect", str(tmp_path / "a.h5"), "--env", "TestArm-v0"])
    assert "no warnings" in capsys.readouterr().out.lower()
    cli.main(["inspect", str(tmp_path / "a.h5"), "--env", "TestOtherArm-v0"])
    printed = " ".join(capsys.readouterr().out.split())
    assert "observations: is Box(-inf, inf, (3,), float32), but the environment has Box(-1.0, 1.0, (4,), float32)" in printed
    assert "action_space: is Box" in printed and "steps, but the environment ends episodes after 3" in printed


@pytest.mark.parametrize(("n_episodes", "warns"), [(2, True), (12, False)])
def test_examples_of_few_episodes_are_few_examples(tmp_path, capsys, n_episodes, warns):
    rng = np.random.default_rng(0)
    with DatasetWriter(tmp_path / "a.h5", STATES, ACTIONS, rewards=False) as writer:
        for _ in range(n_episodes):
            actions = rng.uniform(ACTIONS.low, ACTIONS.high, (10, 2)).astype(np.float32)
            writer.add_episode(rng.normal(size=(11, 3)).astype(np.float32), actions, success=np.ones(10, bool))
    cli.main(["examples", str(tmp_path / "a.h5"), "-n", "20", "-o", str(tmp_path / "e.h5")])
    assert ("20 come from 2 episodes, and frames of one episode" in capsys.readouterr().err) == warns
    cli.main(["inspect", str(tmp_path / "a.h5"), "--examples", str(tmp_path / "e.h5")])
    assert ("they teach hardly more than 2" in " ".join(capsys.readouterr().out.split())) == warns
