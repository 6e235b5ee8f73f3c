import itertools
import pickle

import h5py
import numpy as np
import pytest
import torch as th
from data_files import ACTIONS, BOTH, IMAGES, STATES, write_dataset
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_offline.data import storage as storage_module
from sb3_offline.data.buffer import OfflineReplayBuffer
from sb3_offline.data.convert import convert
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.reader import OfflineDataset
from sb3_offline.data.writer import DatasetWriter

CHANNEL_FIRST = spaces.Box(0, 255, (3, 8, 6), np.uint8)
GAMMA = 0.9


def transitions_by_slow_loop(episodes, n_steps, next_actions):
    """Every field of every step that may be sampled, one step at a time."""
    rows = []
    for episode in episodes:
        obs, done, reward = episode["observations"], episode["terminated"], episode["rewards"]
        action = (episode["actions"] - ACTIONS.low) / (ACTIONS.high - ACTIONS.low) * 2 - 1
        last = len(action) - 1
        for t in range(len(action)):
            # With next actions a window ends at the last step, which is its own successor.
            own_successor = next_actions and t == last
            end = t
            reward_sum, discount = 0.0, 1.0
            while end - t < n_steps and end < (last if next_actions and not own_successor else last + 1):
                reward_sum += discount * reward[end]
                discount *= GAMMA
                end += 1
            done_at = end - 1
            if own_successor:
                end = t
            one = t if own_successor else t + 1
            rows.append(
                {
                    "observations": obs[t],
                    "actions": action[t],
                    "next_observations": obs[one],
                    "dones": [done[t]],
                    "rewards": [reward[t]],
                    "discounts": [GAMMA],
                    "one_step": (obs[one], [reward[t]], [done[t]], [GAMMA], action[one] if next_actions else None),
                    "n_steps": (obs[end], [reward_sum], [done[done_at]], [discount], action[end] if next_actions else None),
                }
            )
    return rows


def tensors_of(samples):
    """All tensors of a batch, those of its horizons too."""
    parts = [*samples[:6], samples.indices, *itertools.chain.from_iterable(samples.horizons)]
    return [part for part in parts if part is not None]


@pytest.mark.parametrize("storage", ["memory", "mmap"])
@pytest.mark.parametrize("next_actions", [False, True])
@pytest.mark.parametrize("n_steps", [1, 3, 10])
def test_samples_are_those_of_a_slow_loop(tmp_path, n_steps, next_actions, storage):
    episodes = write_dataset(tmp_path / "a.h5", 9, STATES) + write_dataset(tmp_path / "b.h5", 5, STATES, first=20)
    assert min(len(episode["actions"]) for episode in episodes) == 1
    options = {"n_steps": n_steps, "next_actions": next_actions, "gamma": GAMMA, "storage": storage}
    buffer = OfflineReplayBuffer(str(tmp_path / "*.h5"), STATES, ACTIONS, "cpu", **options)
    expected = transitions_by_slow_loop(episodes, n_steps, next_actions)
    assert buffer.size() == len(expected)
    samples = buffer.transitions(np.arange(buffer.size()))
    assert samples.indices.tolist() == list(range(len(expected)))
    assert len(samples.horizons) == (1 if n_steps == 1 else 2)

    def check(values, rows):
        wanted = np.array(rows, dtype=np.float32)
        assert values.dtype == th.float32 and values.shape == wanted.shape
        np.testing.assert_allclose(values.numpy(), wanted, rtol=1e-5, atol=1e-6)

    for name in ("observations", "actions", "next_observations", "dones", "rewards", "discounts"):
        check(getattr(samples, name), [row[name] for row in expected])
    for name, horizon in zip(("one_step", "n_steps"), samples.horizons, strict=False):
        assert (horizon.next_actions is not None) == next_actions
        for index, values in enumerate(horizon if next_actions else horizon[:-1]):
            check(values, [row[name][index] for row in expected])


def test_every_step_is_drawn_equally_often(tmp_path):
    write_dataset(tmp_path / "a.h5", 6, STATES)
    buffer = OfflineReplayBuffer(tmp_path / "a.h5", STATES, ACTIONS, "cpu", next_actions=True, seed=0)
    all_steps = buffer.transitions(np.arange(buffer.size())).observations.numpy()
    drawn = buffer.sample(20_000).observations.numpy()
    counts = (drawn[:, None, 0] == all_steps[None, :, 0]).sum(axis=0)
    expected = 20_000 / buffer.size()
    assert counts.sum() == 20_000 and np.abs(counts - expected).max() < 6 * np.sqrt(expected)


def test_memory_map_and_compressed_files_give_the_same_samples(tmp_path):
    write_dataset(tmp_path / "a.h5", 7)
    write_dataset(tmp_path / "b.h5", 7, first=7)
    convert(tmp_path / "b.h5", tmp_path / "b.small", "compressed", progress_bar=False)
    compressed = [tmp_path / "a.h5", tmp_path / "b.small"]
    sources = {"mmap": str(tmp_path / "*.h5"), "memory": str(tmp_path / "*.h5"), "auto": compressed}
    batches = []
    for storage, source in sources.items():
        buffer = OfflineReplayBuffer(source, CHANNEL_FIRST, ACTIONS, "cpu", storage=storage, n_steps=3, seed=5)
        assert buffer.storage == {"auto": "memory"}.get(storage, storage)
        batches.append([buffer.sample(64) for _ in range(3)])
    for first, *others in zip(*batches, strict=True):
        for other in others:
            for a, b in zip(tensors_of(first), tensors_of(other), strict=True):
                assert th.equal(a, b)
    with pytest.raises(DatasetError, match=r"b.small: observations: is compressed.*convert"):
        OfflineReplayBuffer(compressed, CHANNEL_FIRST, ACTIONS, "cpu", storage="mmap")


@pytest.mark.parametrize(("available", "expected"), [(10_000, "mmap"), (1 << 30, "memory")])
def test_storage_is_chosen_by_the_available_memory(tmp_path, monkeypatch, available, expected):
    assert storage_module.available_memory() > 1 << 20
    monkeypatch.setattr(storage_module, "available_memory", lambda: available)
    write_dataset(tmp_path / "a.h5")
    assert OfflineReplayBuffer(tmp_path / "a.h5", IMAGES, ACTIONS, "cpu").storage == expected


def test_images_turn_channel_first_and_nothing_else(tmp_path):
    write_dataset(tmp_path / "a.h5")
    as_stored = OfflineReplayBuffer(tmp_path / "a.h5", IMAGES, ACTIONS, "cpu", seed=0).sample(16)
    turned = OfflineReplayBuffer(tmp_path / "a.h5", CHANNEL_FIRST, ACTIONS, "cpu", seed=0).sample(16)
    assert turned.observations.dtype == th.uint8 and turned.observations.shape == (16, 3, 8, 6)
    assert turned.observations.is_contiguous(memory_format=th.channels_last)
    for name in ("observations", "next_observations"):
        assert th.equal(getattr(turned, name).permute(0, 2, 3, 1), getattr(as_stored, name))


def test_dict_observations(tmp_path):
    episodes = write_dataset(tmp_path / "a.h5", space=BOTH)
    learner = spaces.Dict({"image": CHANNEL_FIRST, "state": STATES})
    buffer = OfflineReplayBuffer(tmp_path / "a.h5", learner, ACTIONS, "cpu", n_steps=2, storage="mmap")
    samples = buffer.transitions(np.arange(len(episodes[0]["actions"])))
    for key, part in episodes[0]["observations"].items():
        wanted = part.transpose(0, 3, 1, 2) if key == "image" else part
        np.testing.assert_array_equal(samples.observations[key], wanted[:-1])
        np.testing.assert_array_equal(samples.next_observations[key], wanted[1:])
    states = np.concatenate([episode["observations"]["state"] for episode in episodes]).astype(np.float64)
    mean, variance, count = buffer.observation_statistics()["state"]
    np.testing.assert_allclose(mean, states.mean(axis=0))
    np.testing.assert_allclose(variance, states.var(axis=0))
    assert count == len(states) and buffer.observation_statistics()["image"][0].shape == CHANNEL_FIRST.shape


def test_actions_a_little_outside_are_clipped_and_others_warned_of(tmp_path):
    def write(path, actions):
        with DatasetWriter(path, STATES, ACTIONS, success=False, rewards=False) as writer:
            writer.add_episode(np.zeros((3, 3)), actions)
        return OfflineReplayBuffer(path, STATES, ACTIONS, "cpu")

    buffer = write(tmp_path / "a.h5", [[-2.00001, 10.00001], [0, 5]])
    np.testing.assert_array_equal(buffer.actions, [[-1, 1], [0, 0]])
    assert not buffer.sample(8).rewards.any()  # the file has none
    with pytest.warns(UserWarning, match=r"b.h5: actions: 50.0% of the actions are outside"):
        np.testing.assert_array_equal(write(tmp_path / "b.h5", [[-3, 5], [2, 5]]).actions, [[-1, 0], [1, 0]])


def test_an_action_without_a_choice_is_refused(tmp_path):
    fixed = spaces.Box(np.array([-1, 3], np.float32), np.array([1, 3], np.float32))
    with DatasetWriter(tmp_path / "a.h5", STATES, fixed, success=False, rewards=False) as writer:
        writer.add_episode(np.zeros((3, 3)), [[0, 3], [1, 3]])
    with pytest.raises(DatasetError, match=r"a.h5: action_space: leaves no choice in dimension 1"):
        OfflineReplayBuffer(tmp_path / "a.h5", STATES, fixed, "cpu")


def test_resume_continues_with_the_same_batches(tmp_path):
    write_dataset(tmp_path / "a.h5")
    buffer = OfflineReplayBuffer(tmp_path / "a.h5", CHANNEL_FIRST, ACTIONS, "cpu", n_steps=3, next_actions=True, seed=1)
    buffer.sample(5)
    state, copy = buffer.get_rng_state(), pickle.loads(pickle.dumps(buffer))
    wanted = buffer.sample(32)
    other = OfflineReplayBuffer(tmp_path / "a.h5", CHANNEL_FIRST, ACTIONS, "cpu", n_steps=3, next_actions=True)
    other.set_rng_state(state)
    for samples in (copy.sample(32), other.sample(32)):
        assert all(th.equal(a, b) for a, b in zip(tensors_of(samples), tensors_of(wanted), strict=True))


@pytest.mark.parametrize(
    ("observation_space", "action_space", "message"),
    [
        (STATES, ACTIONS, r"observations: is Box\(0, 255, \(8, 6, 3\), uint8\), but the learner has"),
        (spaces.Box(0, 1, (8, 6, 3)), ACTIONS, "observations: is Box.*uint8.*learner has .*float32"),
        (BOTH, ACTIONS, "observation_space: is Box.*learner has Dict"),
        (IMAGES, spaces.Box(-1, 1, (2,)), "action_space: is .*learner has"),
    ],
)
def test_other_spaces_than_the_learners(tmp_path, observation_space, action_space, message):
    write_dataset(tmp_path / "a.h5")
    with pytest.raises(DatasetError, match=message):
        OfflineReplayBuffer(tmp_path / "a.h5", observation_space, action_space, "cpu")


def test_discrete_observations_of_another_number_are_refused(tmp_path):
    with DatasetWriter(tmp_path / "a.h5", spaces.Discrete(5), ACTIONS, success=False, rewards=False) as writer:
        writer.add_episode(np.array([0, 4]), np.zeros((1, 2)))
    with pytest.raises(DatasetError, match=r"observations: is Discrete\(5\), but the learner has Discrete\(3\)"):
        OfflineReplayBuffer(tmp_path / "a.h5", spaces.Discrete(3), ACTIONS, "cpu")
    assert OfflineReplayBuffer(tmp_path / "a.h5", spaces.Discrete(5), ACTIONS, "cpu").size() == 1


def test_action_spaces_of_other_precision_are_the_same(tmp_path):
    write_dataset(tmp_path / "a.h5")
    learner = spaces.Box(ACTIONS.low.astype(np.float64), ACTIONS.high.astype(np.float64), dtype=np.float64)
    assert learner != ACTIONS
    assert OfflineReplayBuffer(tmp_path / "a.h5", IMAGES, learner, "cpu").sample(3).actions.dtype == th.float32


def test_guessed_bounds_of_actions_are_to_be_given(tmp_path):
    path, narrow = tmp_path / "d4rl.h5", spaces.Box(-0.5, 0.5, (2,))
    with h5py.File(path, "w") as file:
        file["observations"], file["actions"] = np.zeros((6, 3), np.float32), np.full((6, 2), 0.25, np.float32)
        file["terminals"] = np.arange(6) == 5
    with pytest.raises(DatasetError, match=r"action_space: is .*give OfflineDataset\(path, action_space=...\)"):
        OfflineReplayBuffer(path, STATES, narrow, "cpu")
    dataset = OfflineDataset(path, action_space=narrow)
    assert (OfflineReplayBuffer(dataset, STATES, narrow, "cpu").actions == 0.5).all()
    with pytest.raises(DatasetError, match="Use the environment"):
        OfflineReplayBuffer(dataset, STATES, spaces.Box(-1, 1, (2,)), "cpu")


def test_buffer_is_fixed(tmp_path):
    write_dataset(tmp_path / "a.h5")
    buffer = OfflineReplayBuffer(tmp_path / "a.h5", IMAGES, ACTIONS, "cpu")
    size = buffer.size()
    buffer.reset()
    assert buffer.size() == size == buffer.buffer_size and buffer.full
    with pytest.raises(DatasetError, match="read-only"):
        buffer.add(None, None, None, None, None, None)
    write_dataset(tmp_path / "empty.h5", 0)
    with pytest.raises(DatasetError, match="holds no episode"):
        OfflineReplayBuffer(tmp_path / "empty.h5", IMAGES, ACTIONS, "cpu")


def test_stock_sac_trains_on_it_through_vec_normalize(tmp_path):
    import gymnasium

    env = gymnasium.make("Pendulum-v1")
    with DatasetWriter(tmp_path / "p.h5", env.observation_space, env.action_space, success=False) as writer:
        observations = [env.reset(seed=0)[0]]
        actions = [env.action_space.sample() for _ in range(60)]
        steps = [env.step(action) for action in actions]
        writer.add_episode(observations + [step[0] for step in steps], actions, rewards=[step[1] for step in steps])
    buffer = OfflineReplayBuffer(tmp_path / "p.h5", env.observation_space, env.action_space, "cpu", seed=0)
    vec_env = VecNormalize(DummyVecEnv([lambda: env]))
    moments = vec_env.obs_rms
    moments.mean, moments.var, moments.count = buffer.observation_statistics()
    everything = buffer.transitions(np.arange(60), env=vec_env)
    assert abs(everything.observations.mean()) < 0.1 and abs(everything.observations.std() - 1) < 0.1
    model = SAC("MlpPolicy", vec_env, buffer_size=1, policy_kwargs={"net_arch": [8]}, device="cpu")
    model.set_logger(configure(None, []))
    model.replay_buffer = buffer
    before = model.critic.state_dict()["qf0.0.weight"].clone()
    model.train(gradient_steps=3, batch_size=16)
    assert not th.equal(before, model.critic.state_dict()["qf0.0.weight"])
