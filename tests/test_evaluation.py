"""Judging without an environment, against what is known exactly."""

import csv

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from data_files import make_episode, write_dataset
from gymnasium import spaces
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from test_algorithms import ACTIONS, POLICIES, files, make  # noqa: F401

from sb3_offline import BC, CQL, IQL
from sb3_offline.data.buffer import OfflineReplayBuffer
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.writer import DatasetWriter
from sb3_offline.evaluation import OfflineEvalCallback, fitted_q_evaluation
from sb3_offline.evaluation.metrics import auc, judge_probabilities, success_to_come
from sb3_offline.experiment.evaluation import evaluate_success
from sb3_offline.experiment.recording import record_episode

CHAIN = spaces.Discrete(4)
MOVES = spaces.Box(-1, 1, (1,), np.float32)
GAMMA = 0.9


def write_chain(path, n_episodes=60, n_steps=12):
    """Four places in a row. Right of the last one the episode terminates with reward 10; each step costs 1. Random moves."""
    rng = np.random.default_rng(0)
    with DatasetWriter(path, CHAIN, MOVES, success=True) as writer:
        for _ in range(n_episodes):
            place, places, moves, rewards = 0, [0], [], []
            while place < 4 and len(moves) < n_steps:
                moves.append(rng.uniform(-1, 1, 1).astype(np.float32))
                place = max(place + (1 if moves[-1] > 0 else -1), 0)
                rewards.append(10.0 if place == 4 else -1.0)
                places.append(min(place, 3))  # after the end nothing counts
            terminated = np.zeros(len(moves), dtype=bool)
            terminated[-1] = place == 4
            writer.add_episode(np.array(places), np.stack(moves), rewards=rewards, terminated=terminated, success=terminated)
    return str(path)


@pytest.mark.parametrize(
    ("goes_right", "exact"), [(True, 10 * GAMMA**3 - (1 - GAMMA**3) / (1 - GAMMA)), (False, -1 / (1 - GAMMA))]
)
def test_fitted_q_evaluation_gives_the_exact_value(tmp_path, goes_right, exact):
    model = IQL("MlpPolicy", None, write_chain(tmp_path / "d.h5"), gamma=GAMMA, seed=0, policy_kwargs={"net_arch": [32]})
    with th.no_grad():
        model.actor.mu.weight.zero_()
        model.actor.mu.bias.fill_(1.0 if goes_right else -1.0)
    before, state = {k: v.clone() for k, v in model.policy.state_dict().items()}, th.get_rng_state()
    values = fitted_q_evaluation(model, n_steps=1000, batch_size=64, learning_rate=5e-3, tau=0.1)
    assert values.shape == (60,)
    np.testing.assert_allclose(values, exact, atol=0.5)
    assert all(th.equal(value, before[name]) for name, value in model.policy.state_dict().items())
    assert th.equal(th.get_rng_state(), state)


def test_what_followed_an_episodes_last_step_counts(files):  # noqa: F811
    model = make("ceborl", "MlpPolicy", files, backup="dataset")
    own, callback = model.replay_buffer, OfflineEvalCallback()
    callback.init_callback(model)
    callback._on_training_start()
    plain = OfflineReplayBuffer(files["MlpPolicy"][0], own.observation_space, own.action_space)
    last = np.cumsum(own.datasets[0].lengths) - 1
    following = callback.buffer.transitions(last).next_observations
    assert th.equal(following, plain.transitions(last).next_observations)
    assert th.equal(
        own.transitions(last).next_observations, own.transitions(last).observations
    )  # the convention of this backup


def test_a_run_is_the_same_with_and_without_and_logs_what_applies(files, tmp_path):  # noqa: F811
    write_dataset(tmp_path / "held_out.h5", 4, POLICIES["MlpPolicy"], first=20)
    wanted = {
        "bc": {"data_return", "fqe_value"},
        "cql": {"data_return", "fqe_value", "td_error", "initial_value", "initial_value_std"},
    }
    judged = {f"{kind}_{name}" for kind in ("examples", "success") for name in ("accuracy", "auc", "calibration_error")}
    wanted["ceborl"] = wanted["oril"] = wanted["cql"] | judged
    for algo, names in wanted.items():
        examples = files["MlpPolicy"][1]
        callback = OfflineEvalCallback(str(tmp_path / "held_out.h5"), examples, eval_freq=2, fqe_steps=2)
        model = make(algo, "MlpPolicy", files)
        model.set_logger(configure(str(tmp_path / algo), ["csv"]))
        model.learn(5, callback, log_interval=3)
        with (tmp_path / algo / "progress.csv").open() as file:
            rows = [{name: value for name, value in row.items() if value} for row in csv.DictReader(file)]
        logged = {int(row["time/total_timesteps"]): row for row in rows if "offline_eval/data_return" in row}
        assert logged.keys() == {2, 4}  # each under its own step, whenever the rest is logged
        for row in logged.values():
            found = {name.split("/")[1]: float(value) for name, value in row.items() if "offline_eval" in name}
            assert found.keys() == names and np.isfinite(list(found.values())).all()
        plain = make(algo, "MlpPolicy", files).learn(5, log_interval=None)
        for name, value in model.policy.state_dict().items():
            assert th.equal(value, plain.policy.state_dict()[name]), name


def test_td_error_and_returns_are_those_of_their_definition(tmp_path):
    """A critic that says 7 everywhere, on a chain whose rewards are -1 and, where it ends, 10."""
    model = CQL("MlpPolicy", None, write_chain(tmp_path / "d.h5"), gamma=GAMMA, seed=0, policy_kwargs={"net_arch": [8]})
    callback = OfflineEvalCallback(n_transitions=10**6)
    callback.init_callback(model)
    callback._on_training_start()
    with th.no_grad():
        for critic in (model.critic, model.critic_target):
            for head in critic.q_networks:
                head[-1].weight.zero_(), head[-1].bias.fill_(7.0)
    found = callback.evaluate()
    share = model.replay_buffer.dones.mean()
    assert found["td_error"] == pytest.approx(share * 3 + (1 - share) * abs(7 - (-1 + GAMMA * 7)), rel=1e-5)
    assert found["initial_value"] == pytest.approx(7) and found["initial_value_std"] == pytest.approx(0)
    dataset = model.replay_buffer.datasets[0]
    returns = []
    for start, n in zip(dataset.step_starts, dataset.lengths, strict=True):
        returns.append(sum(GAMMA**t * dataset.rewards[start + t] for t in range(n)))
    assert found["data_return"] == pytest.approx(np.mean(returns), rel=1e-5)
    env = VecNormalize(model.get_env(), norm_obs=False)
    model.set_env(env)
    assert callback.evaluate()["data_return"] == pytest.approx(np.mean(returns) / np.sqrt(env.ret_rms.var + 1e-8), rel=1e-5)


def test_probabilities_are_judged_by_what_they_say():
    rng = np.random.default_rng(0)
    probabilities = rng.uniform(size=100_000)
    labels = rng.uniform(size=100_000) < probabilities
    judged = judge_probabilities(probabilities, labels)  # calibrated, half of them positive
    assert judged["calibration_error"] < 0.01 and judged["accuracy"] == pytest.approx(0.75, abs=0.01)
    assert judged["auc"] == pytest.approx(5 / 6, abs=0.01)
    assert judge_probabilities(np.array([0.9, 0.9, 0.9, 0.9]), np.array([True, False, True, False]))[
        "calibration_error"
    ] == pytest.approx(0.4)
    assert auc(np.array([1, 2, 2, 3]), np.array([False, False, True, True])) == pytest.approx(3.5 / 4)
    come = success_to_come(np.array([0, 1, 0, 0, 0, 1], dtype=bool), np.array([3, 1, 2]))
    assert come.tolist() == [True, True, False, False, True, True]


def test_held_out_data_get_the_models_rewards(files):  # noqa: F811
    dataset = files["MlpPolicy"][0]
    model = CQL("MlpPolicy", None, dataset, reward_fn="success", policy_kwargs={"net_arch": [8]}).learn(1)
    found = []
    for data in (None, dataset):
        callback = OfflineEvalCallback(data, fqe_steps=1)
        callback.init_callback(model)
        callback.on_training_start({}, {})
        found.append(callback.evaluate())
    assert found[0] == pytest.approx(found[1]) and "fqe_value" in found[0]


def test_data_without_rewards_cannot_be_evaluated_on(tmp_path):
    episode = make_episode(0, POLICIES["MlpPolicy"])
    with DatasetWriter(tmp_path / "d.h5", POLICIES["MlpPolicy"], ACTIONS, rewards=False, success=False) as writer:
        writer.add_episode(episode["observations"], episode["actions"])
    with pytest.raises(DatasetError, match="rewards: are missing, so a policy has no value"):
        fitted_q_evaluation(BC("MlpPolicy", None, str(tmp_path / "d.h5")), n_steps=1)


class Far(gym.Env):
    """One decision: right below 500, left above. Policies that learn from normalised observations fail on plain ones."""

    observation_space, action_space = gym.spaces.Box(0, 1000, (1,)), gym.spaces.Box(-1, 1, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = self.np_random.uniform(0, 1000)
        return np.array([self.x], np.float32), {}

    def step(self, action):
        good = bool((action[0] > 0) == (self.x < 500))
        return np.array([self.x], np.float32), float(good), True, False, {"is_success": good}


def test_what_was_learned_normalised_is_judged_normalised(tmp_path):
    gym.register("TestFar-v0", Far)
    rng = np.random.default_rng(0)
    with DatasetWriter(tmp_path / "far.h5", Far.observation_space, Far.action_space, success=False) as writer:
        for _ in range(20):
            x = rng.uniform(0, 1000, (21, 1))
            writer.add_episode(x, np.where(x[:-1] < 500, 0.8, -0.8), rewards=np.ones(20))
    env = VecNormalize(DummyVecEnv([lambda: Monitor(Far())]), norm_reward=False)
    settings = {"seed": 0, "learning_rate": 3e-3, "policy_kwargs": {"net_arch": [32]}}
    model = BC("MlpPolicy", env, str(tmp_path / "far.h5"), **settings).learn(400)
    env.training = False
    assert evaluate_policy(model, env, 50)[0] > 0.9
    model.save(tmp_path / "model")
    bare = BC.load(tmp_path / "model")  # without its environment: the statistics come with the model
    for player in (model, bare):
        assert evaluate_success(player, "TestFar-v0", {}, 50).success_rate > 0.9
        frames = record_episode(player, Drawn(), seed=1)
        assert frames[1] == 1
        with pytest.raises(RuntimeError, match="VecNormalize"):
            player.predict(np.array([700.0], np.float32))
        plain = player.observation_normalizer().normalize_obs(np.array([[700.0], [300.0]]))
        assert (player.predict(plain, deterministic=True)[0][:, 0] < 0).tolist() == [True, False]
    assert evaluate_policy(bare, env, 50)[0] > 0.9  # as in SB3
    with pytest.raises(RuntimeError, match="VecNormalize"):
        fitted_q_evaluation(bare, model.replay_buffer, n_steps=1)


class Drawn(Far):
    def render(self):
        return np.zeros((8, 8, 3), np.uint8)
