import gymnasium as gym
import numpy as np
import pytest

import sb3_offline.envs  # noqa: F401

pytest.importorskip("metaworld")

from sb3_offline.data.reader import OfflineDataset
from sb3_offline.data_tools.collecting.scripted import collect_scripted, scripted_episodes
from sb3_offline.data_tools.converting.extract_examples import extract_examples
from sb3_offline.data_tools.converting.render_dataset import draw_moments
from sb3_offline.data_tools.inspecting.dataset_statistics import inspect_dataset, table_coverage
from sb3_offline.data_tools.inspecting.joined_datasets import JoinedDatasets
from sb3_offline.envs.multimodal_metaworld import TABLES, TASKS
from sb3_offline.envs.multimodal_metaworld.scene import JITTER


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


def test_another_table_is_collected_inspected_drawn_and_learned_from_by_the_same_programs(tmp_path):
    path, tasks = tmp_path / "second.h5", tuple(TABLES["second"])
    collect_scripted(path, episodes_per_task=1, seed=1, n_workers=1, progress=False, table="second")
    data = OfflineDataset(path)
    assert data.sources == list(tasks) and data.env_kwargs == {"obs_type": "state", "table": "second"}
    env = gym.make(data.env_id, **data.env_kwargs)
    observation, _ = env.reset(seed=int(data.seeds[3]))
    for step in range(50):
        np.testing.assert_array_equal(observation, data.observations[data.observation_starts[3] + step])
        row = data.step_starts[3] + step
        observation, *_, info = env.step(data.actions[row])
        np.testing.assert_array_equal(info["task_success"], data.extras["task_success"][row])
        np.testing.assert_array_equal(env.unwrapped.scene.get_state(), data.extras["scene_state"][row])
        assert data.success[row] == info["task_success"][3]

    summary, coverage = inspect_dataset(path), table_coverage(JoinedDatasets(path))
    assert list(summary["tasks"]["window-open"]) == list(tasks)
    assert np.abs(np.subtract(coverage.bodies["window"], TABLES["second"]["window-open"]["window"][:2])).max() <= JITTER
    frames = draw_moments(data, 3, np.array([0, 50]))
    env = gym.make("MultimodalMetaworld-v0", table="second")
    np.testing.assert_array_equal(env.reset(seed=int(data.seeds[3]))[0], frames[0])
    env.close()
    examples, _ = extract_examples(path, 10, source="faucet-open")
    angle = env.unwrapped.state_names.index("faucet_angle")
    assert examples.shape == (10, len(env.unwrapped.state_names)) and (examples[:, angle] > 1.2).all()


@pytest.mark.parametrize(("table", "task"), [("paper", "window-open"), ("second", "door-open")])
def test_tasks_of_another_table_are_named(table, task):
    with pytest.raises(ValueError, match=f"'{task}'.* of table '{table}'; choose from {', '.join(TABLES[table])}"):
        next(scripted_episodes(1, tasks=(task,), table=table))
