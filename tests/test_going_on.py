"""A saved model continues: with other data, another seed, a saved buffer or another environment."""

import h5py
import numpy as np
import pytest
import torch as th
from data_files import forget_checksums, write_dataset
from stable_baselines3 import SAC
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from test_algorithms import STATES, ForbiddenEnv

from sb3_offline import CEBORL, CQL, DCQL, TD3BC
from sb3_offline.data.errors import DatasetError

SMALL = {"batch_size": 8, "policy_kwargs": {"net_arch": [8]}, "device": "cpu", "seed": 0}


@pytest.fixture
def paths(tmp_path):
    """Two datasets of the same length, with different actions and rewards."""
    for name in ("a", "b"):
        write_dataset(tmp_path / f"{name}.h5", 6, STATES)
    with h5py.File(tmp_path / "b.h5", "r+") as file:
        file["actions"][:] = file["actions"][:][::-1]
        file["rewards"][:] += 5
        forget_checksums(file)
    return str(tmp_path / "a.h5"), str(tmp_path / "b.h5")


def weights(model):
    return th.cat([parameter.flatten() for parameter in getattr(model, "policy", model).parameters()])


def test_a_saved_buffer_brings_its_place_and_no_other_data(paths, tmp_path):
    model = CQL("MlpPolicy", None, paths[0], **SMALL).learn(2)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    state = model.replay_buffer.get_rng_state()

    model.replay_buffer.sample(3)
    model.load_replay_buffer(tmp_path / "buffer")
    assert model.replay_buffer.get_rng_state() == state

    other = CQL.load(tmp_path / "model", dataset=paths[1])
    with pytest.warns(UserWarning, match="over other data"):
        other.load_replay_buffer(tmp_path / "buffer")
    assert str(other.replay_buffer.datasets[0].path) == paths[1]
    relabelled = CQL.load(tmp_path / "model", reward_fn="success")
    relabelled.load_replay_buffer(tmp_path / "buffer")
    assert set(np.unique(relabelled.replay_buffer.rewards)) == {0, 1}
    bare = CQL("MlpPolicy", ForbiddenEnv(STATES), **SMALL, n_steps=3)
    bare.load_replay_buffer(tmp_path / "buffer")
    assert bare.learn(1).policy.standardizes  # the loaded buffer has 1-step transitions


def test_kept_transitions_are_those_of_the_dataset(paths, tmp_path):
    examples = np.zeros((4, 3), np.float32)
    model = CEBORL("MlpPolicy", None, paths[0], examples, n_action_samples=2, **SMALL).learn(3)
    model.save(tmp_path / "model")
    same, other = (CEBORL.load(tmp_path / "model", dataset=path, examples=examples) for path in paths)
    kept = []
    for again in (same, other):
        again.learn(1, reset_num_timesteps=False)
        kept.append(int((again._extraction.pool.weights > 0).sum()))
    assert kept[0] > kept[1] > 0


def test_a_loaded_model_takes_another_delay(paths, tmp_path):
    TD3BC("MlpPolicy", None, paths[0], **SMALL).save(tmp_path / "model")
    model = TD3BC.load(tmp_path / "model", policy_delay=3)
    before = {name: weights(getattr(model, name)) for name in ("actor", "critic_target")}
    for steps, moved in ((2, False), (1, True)):
        model.learn(steps, reset_num_timesteps=False)
        assert {name: not th.equal(weights(getattr(model, name)), then) for name, then in before.items()} == dict.fromkeys(
            before, moved
        )


def test_a_seed_makes_a_loaded_model_go_on_otherwise(paths, tmp_path):
    CQL("MlpPolicy", None, paths[0], **SMALL).learn(2).save(tmp_path / "model")
    ends = [
        weights(CQL.load(tmp_path / "model", **kwargs).learn(2)) for kwargs in ({}, {}, {"seed": 1}, {"seed": 1}, {"seed": 2})
    ]
    assert th.equal(ends[0], ends[1]) and th.equal(ends[2], ends[3])
    assert not th.equal(ends[0], ends[2]) and not th.equal(ends[2], ends[4])
    model = CQL.load(tmp_path / "model")
    model.set_random_seed(1)
    assert th.equal(weights(model.learn(2)), ends[2])


def test_another_normaliser_counts_for_all_that_is_learned_from(paths, tmp_path):
    def normaliser(mean):
        env = VecNormalize(DummyVecEnv([lambda: ForbiddenEnv(STATES, allowed=True)]), norm_obs=mean is not None)
        if mean is not None:
            env.obs_rms.mean[:] = mean
        env.training = mean is None  # otherwise its statistics would become those of the dataset
        return env

    model = CQL("MlpPolicy", None, paths[0], **SMALL).learn(1)
    model.set_env(normaliser(None))
    assert model.get_vec_normalize_env().ret_rms.var == CQL("MlpPolicy", normaliser(None), paths[0], **SMALL).learn(
        1
    ).get_vec_normalize_env().ret_rms.var != 1  # fmt: skip

    examples = np.full((4, 3), 5, np.float32)
    for algorithm in (CEBORL, DCQL):
        model = algorithm("MlpPolicy", normaliser(0), paths[0], examples, **SMALL).learn(1)
        model.save(tmp_path / "model")
        model.set_env(normaliser(5))
        again = algorithm.load(tmp_path / "model", env=normaliser(5), examples=examples).learn(1)
        np.testing.assert_array_equal(model.all_examples(), np.zeros((4, 3)))
        np.testing.assert_array_equal(model.replay_buffer.rewards, again.replay_buffer.rewards)


def test_a_buffer_of_sac_is_a_dataset(tmp_path):
    env = ForbiddenEnv(STATES, allowed=True)
    sac = SAC("MlpPolicy", env, buffer_size=50, learning_starts=100, policy_kwargs={"net_arch": [4]}).learn(20)
    sac.save_replay_buffer(tmp_path / "sac")
    model = CQL("MlpPolicy", env, **SMALL)
    model.load_replay_buffer(tmp_path / "sac")
    assert model.replay_buffer.size() > 10 and model.learn(1).num_timesteps == 1
    with pytest.raises(DatasetError, match=r"sac: replay buffer: is a ReplayBuffer.*dataset=PATH"):
        model.load_replay_buffer(tmp_path / "sac")


def test_a_policy_of_normalised_observations_asks_for_its_environment(paths, tmp_path):
    env = VecNormalize(DummyVecEnv([lambda: ForbiddenEnv(STATES, allowed=True)]), norm_reward=False)
    model = CQL("MlpPolicy", env, paths[0], **SMALL).learn(2)
    model.save(tmp_path / "model")
    observation = np.ones(3, np.float32)
    before = model.predict(observation, deterministic=True)[0]
    again = CQL.load(tmp_path / "model")
    for refused in (lambda: again.learn(1), lambda: model.set_env(ForbiddenEnv(STATES, allowed=True))):
        with pytest.raises(RuntimeError, match="VecNormalize"):
            refused()
    assert model.get_vec_normalize_env() is env
    for one in (model, again):
        np.testing.assert_array_equal(one.predict(observation, deterministic=True)[0], before)
    CQL.load(tmp_path / "model", env=env).learn(1)
