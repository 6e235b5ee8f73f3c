import gymnasium as gym
import numpy as np
import pytest

import sb3_offline.envs  # noqa: F401

pytest.importorskip("metaworld")

from sb3_offline.data.reader import OfflineDataset
from sb3_offline.data_tools.collecting.scripted import collect_scripted, scripted_episodes
from sb3_offline.envs.multimodal_metaworld import TASKS


def test_the_file_is_the_same_for_any_number_of_workers_and_says_what_it_is(tmp_path):
    paths = [tmp_path / "one.h5", tmp_path / "two.h5"]
    shares = [
        collect_scripted(path, episodes_per_task=2, seed=1, n_workers=n, progress=False)
        for n, path in enumerate(paths, start=1)
    ]
    one, two = map(OfflineDataset, paths)
    assert shares[0] == shares[1] and set(shares[0]) == set(TASKS)
    assert one.arrays.keys() == two.arrays.keys()
    for name, array in one.arrays.items():
        np.testing.assert_array_equal(array, two.arrays[name])
    assert one.n_episodes == 10 and list(one.lengths) == [50] * 10
    assert [one.sources[i] for i in one.source] == [*TASKS, *TASKS]
    assert one.env_id == "MultimodalMetaworld-v0" and "no learned agents" in one.provenance["policy"]
    own = np.repeat([TASKS.index(one.sources[i]) for i in one.source], one.lengths)
    np.testing.assert_array_equal(one.success, one.extras["task_success"][np.arange(one.n_steps), own])

    # Seed and actions give the episode again.
    env = gym.make(one.env_id, **one.env_kwargs)
    observation, _ = env.reset(seed=int(one.seeds[7]))
    for step in range(50):
        row = one.observation_starts[7] + step
        np.testing.assert_array_equal(observation, one.observations[row])
        observation, *_, info = env.step(one.actions[one.step_starts[7] + step])
        np.testing.assert_array_equal(info["task_success"], one.extras["task_success"][one.step_starts[7] + step])


def test_attempts_succeed_and_fail_and_explore():
    episodes = list(scripted_episodes(12, tasks=("door-open", "drawer-open"), seed=0, n_workers=1))
    solved = [episode.task_success[:, TASKS.index(episode.task)].any() for episode in episodes]
    assert 0 < sum(solved) < len(solved)
    actions = np.concatenate([episode.actions for episode in episodes])
    assert (actions.std(axis=0) > 0.3).all() and (np.abs(actions[:, :3]) < 0.99).mean() > 0.7


def test_unknown_tasks_are_named():
    with pytest.raises(ValueError, match="open-door"):
        next(scripted_episodes(1, tasks=("open-door",)))
