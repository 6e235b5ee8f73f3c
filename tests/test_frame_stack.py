"""Stacks of frames: the buffer's are those of SB3's VecFrameStack, and policies play in it."""

import sys

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from data_files import ACTIONS, OPTIONS, make_episode, make_observations
from gymnasium import spaces
from PIL import Image
from point_mass import write_point_mass
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize, VecTransposeImage

from sb3_offline import BC, CEBORL, DCQL, IQL, cli
from sb3_offline.common.online import export_sac
from sb3_offline.data.buffer import OfflineReplayBuffer
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.stacking import EpisodeStack, frame_space, stacked_space
from sb3_offline.data.writer import DatasetWriter
from sb3_offline.evaluation import OfflineEvalCallback, fitted_q_evaluation
from sb3_offline.experiment.evaluation import evaluate_success
from sb3_offline.experiment.policy_file import load_policy, save_policy
from sb3_offline.experiment.recording import record_gif
from sb3_offline.experiment.training import create_model

VECTORS = spaces.Box(-np.inf, np.inf, (3,), np.float32)
CHANNEL_LAST, CHANNEL_FIRST = spaces.Box(0, 255, (40, 36, 3), np.uint8), spaces.Box(0, 255, (3, 40, 36), np.uint8)
BOTH = spaces.Dict({"image": CHANNEL_LAST, "state": VECTORS})
SMALL = {"net_arch": [8], "features_extractor_kwargs": {"cnn_output_dim": 8}}


class Replay(gym.Env):
    """Plays the episodes of a dataset again, one after the other."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(self, space=BOTH, render_mode=None):
        self.observation_space, self.action_space, self.render_mode, self.episode = space, ACTIONS, render_mode, -1

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.episode, self.t = self.episode + 1, 0
        self.rows = make_episode(self.episode, self.observation_space)["observations"]
        return self._seen(), {}

    def step(self, action):
        self.t += 1
        n = len(self.rows["state"] if isinstance(self.rows, dict) else self.rows) - 1
        return self._seen(), 1.0, False, self.t == n, {"is_success": True}

    def render(self):
        return np.zeros((16, 16, 3), np.uint8)

    def _seen(self):
        return {key: part[self.t] for key, part in self.rows.items()} if isinstance(self.rows, dict) else self.rows[self.t]


gym.register("TestReplay-v0", entry_point=Replay)


def write(path, space, n_episodes=5):
    with DatasetWriter(path, space, ACTIONS, **OPTIONS) as writer:
        for index in range(n_episodes):
            writer.add_episode(**make_episode(index, space))
    return str(path)


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    return write(tmp_path_factory.mktemp("both") / "both.h5", BOTH)


def as_dict(observations):
    return observations if isinstance(observations, dict) else {"": observations}


@pytest.mark.parametrize("space", [VECTORS, CHANNEL_LAST, CHANNEL_FIRST, BOTH], ids=["vectors", "last", "first", "both"])
def test_the_buffer_stacks_as_vec_frame_stack_does_when_the_same_episodes_are_played(tmp_path, space):
    path = write(tmp_path / "d.h5", space)
    env = VecFrameStack(DummyVecEnv([lambda: Replay(space)]), 3)
    if space in (CHANNEL_LAST, BOTH):
        env = VecTransposeImage(env)  # as SB3 does it for every model
    buffer = OfflineReplayBuffer(path, env.observation_space, ACTIONS, "cpu", n_steps=2, n_stack=3)
    batch = buffer.transitions(np.arange(buffer.size()))
    observation, row, long_window = env.reset(), 0, {}
    for length in buffer.datasets[0].lengths:
        for t in range(length):
            assert_same(batch.observations, row, observation)
            if row in long_window:
                assert_same(batch.horizons[1].observations, long_window[row], observation)
            long_window[row + 2] = row if t + 2 < length else None
            observation, _, dones, infos = env.step(np.zeros((1, 2)))
            last = infos[0]["terminal_observation"] if dones[0] else None
            following = (
                observation
                if last is None
                else {k: v[None] for k, v in last.items()} if isinstance(last, dict) else last[None]
            )
            assert_same(batch.next_observations, row, following)
            if t == length - 1:
                assert_same(batch.horizons[1].observations, row, following)
            long_window = {key: value for key, value in long_window.items() if value is not None}
            row += 1
    names = [name for name in buffer.datasets[0].arrays if name.startswith("observations")]
    assert all(len(buffer._stores[name]) == len(buffer.datasets[0].arrays[name]) for name in names)  # each frame once


def assert_same(batch, row, played):
    for key, part in as_dict(batch).items():
        np.testing.assert_array_equal(part[row].numpy(), as_dict(played)[key][0])


def test_spaces_and_single_environments():
    for space in (VECTORS, CHANNEL_LAST, CHANNEL_FIRST, BOTH):
        stacked = VecFrameStack(DummyVecEnv([lambda: Replay(space)]), 4).observation_space  # noqa: B023
        assert stacked_space(space, 4) == stacked and frame_space(stacked, 4) == space
    env, played = Replay(), VecFrameStack(DummyVecEnv([Replay]), 4)
    stack = EpisodeStack(BOTH, 4)
    for mine, theirs in (
        (stack.reset(env.reset()[0]), played.reset()),
        (stack.add(env.step(None)[0]), played.step([None])[0]),
    ):
        for key in BOTH:
            np.testing.assert_array_equal(mine[key], theirs[key][0])
    for n_stack, space, error, message in [
        (0, VECTORS, TypeError, "n_stack is 0; give a whole number"),
        (2, spaces.Discrete(3), DatasetError, r"is Discrete\(3\), which has no frames"),
        (2, spaces.Dict({"a": VECTORS, "b": spaces.Discrete(3)}), DatasetError, r"'b' is Discrete\(3\)"),
    ]:
        with pytest.raises(error, match=message):
            stacked_space(space, n_stack)
    with pytest.raises(DatasetError, match="is no stack of 4 frames"):
        frame_space(spaces.Box(-1, 1, (6,)), 4)


def make(dataset, env=None, algorithm=IQL, **kwargs):
    return algorithm("MultiInputPolicy", env, dataset, batch_size=8, seed=0, n_stack=2, policy_kwargs=SMALL, **kwargs)


def test_a_model_plays_and_is_judged_in_stacks_wherever_it_is(both, tmp_path):
    model = make(both, "TestReplay-v0").learn(2)
    assert model.observation_space["image"].shape == (6, 40, 36) and model.observation_space["state"].shape == (6,)
    weights = [make(both, env).learn(2).policy.state_dict() for env in (None, VecFrameStack(make_vec_env("TestReplay-v0"), 2))]
    for other in weights:
        assert all(th.equal(value, other[name]) for name, value in model.policy.state_dict().items())
    own = VecFrameStack(make_vec_env("TestReplay-v0"), 2)
    assert evaluate_policy(model, own, 2)[0] > 0 and evaluate_policy(model, model.get_env(), 2)[0] > 0
    assert evaluate_success(model, "TestReplay-v0", {}, 2).success_rate == 1
    assert record_gif(model, "TestReplay-v0", {}, tmp_path / "a.gif", n_episodes=1) == [True]
    save_policy(
        tmp_path / "policy.npz",
        model,
        {"algo": "iql", "env": "TestReplay-v0", "env_kwargs": {}, "policy": "MultiInputPolicy", "policy_kwargs": SMALL},
    )
    assert evaluate_success(load_policy(tmp_path / "policy.npz")[0], "TestReplay-v0", {}, 1).success_rate == 1
    assert len(fitted_q_evaluation(model, n_steps=1, batch_size=4)) == 5
    export_sac(model, tmp_path / "sac", data_ratio=0.5)

    model.save(tmp_path / "model")
    model.learn(1, reset_num_timesteps=False)
    for env in (None, Replay(), own):
        loaded = IQL.load(tmp_path / "model", env=env)
        if env is None:
            loaded.set_env(Replay())
        loaded.learn(1, reset_num_timesteps=False)
        assert all(th.equal(value, loaded.policy.state_dict()[name]) for name, value in model.policy.state_dict().items())
    with pytest.raises(TypeError, match="n_stack is 0; give a whole number"):
        IQL("MultiInputPolicy", Replay(), both, n_stack=0)
    with pytest.raises(TypeError, match="stacks 2 frames; give n_stack=2, not 3"):
        IQL("MultiInputPolicy", own, both, n_stack=3)
    with pytest.raises(TypeError, match=r"normalises single frames.*VecNormalize\(VecFrameStack\(env, 2\)\)"):
        make(both, VecNormalize(make_vec_env("TestReplay-v0"), norm_obs_keys=["state"]))


def test_a_normaliser_of_stacks_is_fitted_to_the_data(tmp_path):
    path = write(tmp_path / "d.h5", VECTORS)
    env = VecNormalize(VecFrameStack(DummyVecEnv([lambda: Replay(VECTORS)]), 2))
    model = IQL("MlpPolicy", env, path, batch_size=8, n_stack=2, policy_kwargs={"net_arch": [8]}).learn(1)
    rows = np.concatenate([make_episode(index, VECTORS)["observations"] for index in range(5)])
    np.testing.assert_allclose(env.obs_rms.mean, np.tile(rows.mean(axis=0), 2), atol=1e-6)
    raw, seen = (model.replay_buffer.transitions(np.arange(4), e).observations.numpy() for e in (None, env))
    np.testing.assert_array_equal(seen, env.normalize_obs(raw))


def test_an_example_is_one_frame_that_is_repeated(both, tmp_path):
    frames = make_observations(CHANNEL_LAST, 3, np.random.default_rng(0))
    for index, frame in enumerate(frames):
        Image.fromarray(frame).save(tmp_path / f"{index}.png")
    evaluation = OfflineEvalCallback(both, str(tmp_path), eval_freq=2, n_transitions=8)
    model = make(both, "TestReplay-v0", CEBORL, examples=str(tmp_path), example_batch_size=4)
    model.learn(2, callback=evaluation)
    repeated = np.concatenate([frames, frames], axis=-1).transpose(0, 3, 1, 2)
    np.testing.assert_array_equal(model.all_examples()["image"].numpy(), repeated)
    assert evaluation.example_observations["image"].shape == repeated.shape
    moving = np.concatenate([frames, frames[::-1]], axis=-1)  # whole stacks
    model = make(both, None, DCQL, examples={"image": moving})
    np.testing.assert_array_equal(model.all_examples()["image"].numpy(), moving.transpose(0, 3, 1, 2))
    with pytest.raises(DatasetError, match=r"expected \(n, 3, 40, 36\)"):
        make(both, None, DCQL, examples={"image": moving[..., :5]}).learn(1)


def test_a_config_names_it_as_the_rl_zoo_does(both):
    model = create_model("iql", {"policy": "MultiInputPolicy", "frame_stack": 3, "policy_kwargs": SMALL}, both)
    assert model.n_stack == 3 and model.observation_space["state"].shape == (9,)


CONFIG = """
TestPointMass-v0:
  {policy: MlpPolicy, n_timesteps: 4, dataset: points.h5, batch_size: 8, policy_kwargs: {net_arch: [8]}, NAME: 3}
"""


@pytest.mark.parametrize("name", ["frame_stack", "n_stack"])
def test_programs_stack_frames_by_either_name(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_point_mass("points.h5", n_episodes=10)
    (tmp_path / "my.yml").write_text(CONFIG.replace("NAME", name))
    options = ["--algo", "bc", "--env", "TestPointMass-v0"]
    cli.main(["train", *options, "--config", "my.yml", "-o", "run", "--eval-freq", "2", "--eval-episodes", "1"])
    cli.main(["evaluate", "run/model.zip", "--episodes", "2"])
    assert "of 2 episodes solved" in capsys.readouterr().out

    pytest.importorskip("rl_zoo3")
    from rl_zoo3.enjoy import enjoy

    from sb3_offline.zoo import train

    for program, rest in (
        (train.main, ["--conf-file", "my.yml", "--seed", "0", "--eval-freq", "2", "--eval-episodes", "1"]),
        (enjoy, ["-f", "logs", "--no-render", "-n", "25", "--load-best"]),
    ):
        monkeypatch.setattr(sys, "argv", ["program", *options, *rest])
        program()
    assert "Stacking 3 frames" in capsys.readouterr().out
    assert BC.load("logs/bc/TestPointMass-v0_1/best_model.zip").n_stack == 3
