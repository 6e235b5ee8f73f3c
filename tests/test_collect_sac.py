"""collect-sac gives the same episodes for any number of workers, shards and restarts."""

import json
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("metaworld")

from sb3_offline import cli
from sb3_offline.common.provenance import SIMULATION_PACKAGES, installed_versions
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.examples import load_examples
from sb3_offline.data.reader import OfflineDataset, open_datasets
from sb3_offline.data_tools import POLICIES, SAMPLES
from sb3_offline.data_tools.collecting import sac
from sb3_offline.data_tools.collecting.sac import PAPER_SHARES, Collection, collect_shard, content_hash, success_shares
from sb3_offline.data_tools.sac.policies import load_policies, mix_weights
from sb3_offline.envs.multimodal_metaworld import TASKS

EPISODES = 4
COLLECTION = Collection(EPISODES, ("door-open", "dial-turn"), seed=3)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return collect_shard(tmp_path_factory.mktemp("sac") / "whole.h5", COLLECTION, progress=False)


def _same(one, other):
    return all(np.array_equal(array, other.arrays[name]) for name, array in one.arrays.items())


def test_workers_and_restarts_change_nothing(whole, tmp_path, monkeypatch):
    path = tmp_path / "stopped.h5"
    add_episode = sac.add_episode

    def killed(writer, episode):
        if writer.n_episodes == 3:
            raise KeyboardInterrupt
        add_episode(writer, episode)

    monkeypatch.setattr(sac, "add_episode", killed)
    with pytest.raises(KeyboardInterrupt):
        collect_shard(path, COLLECTION, progress=False)
    monkeypatch.undo()
    assert OfflineDataset(path).n_episodes == 3
    collect_shard(path, COLLECTION, n_workers=2, progress=False)
    assert _same(OfflineDataset(whole), OfflineDataset(path))
    before = path.stat().st_mtime_ns
    collect_shard(path, COLLECTION, progress=False)
    assert path.stat().st_mtime_ns == before
    with pytest.raises(DatasetError, match="other data"):
        collect_shard(path, Collection(EPISODES, COLLECTION.tasks, seed=4), progress=False)
    with pytest.raises(DatasetError, match="other data"):  # the tasks take turns in another order
        collect_shard(path, replace(COLLECTION, tasks=COLLECTION.tasks[::-1]), progress=False)


def test_shards_are_the_whole_in_parts(whole, tmp_path):
    paths = [collect_shard(tmp_path / "part.h5", COLLECTION, i, 3, progress=False) for i in range(3)]
    assert [OfflineDataset(path).n_episodes for path in paths] == [2, 2, 4]
    assert [dataset.path for dataset in open_datasets(str(tmp_path / "part-*.h5"))] == paths
    assert content_hash(paths) == content_hash(whole)


def test_the_command_leaves_data_examples_and_card(tmp_path, capsys):
    command = ["collect-sac", str(tmp_path / "data.h5"), "--episodes-per-task", "3", "--tasks", "door-open", "--workers", "1"]
    command += ["--obs-type", "pixels", "--examples", str(tmp_path / "examples"), "--example-count", "5"]
    cli.main([*command, "--example-episodes", "6", "--card", str(tmp_path / "card.json")])
    data = OfflineDataset(tmp_path / "data.h5")
    states = collect_shard(tmp_path / "states.h5", Collection(3, ("door-open",)), progress=False)
    assert data.observations.shape == (153, 64, 64, 3)
    assert content_hash(data) == content_hash(states)
    assert content_hash(data) in capsys.readouterr().out
    card = json.loads((tmp_path / "card.json").read_text())
    assert card["tasks"]["door-open"]["episodes"] == 3 and card["bytes_per_decision"]["contiguous"] > 64 * 64 * 3
    assert card["tasks"]["door-open"]["success_share"] == pytest.approx(
        np.logical_or.reduceat(data.success, data.step_starts).mean(), abs=1e-4
    )

    examples = load_examples(tmp_path / "examples/door-open.h5", data.observation_space)
    assert examples.shape == (5, 64, 64, 3)
    held_out = OfflineDataset(tmp_path / "examples/held_out.h5")
    assert not set(held_out.seeds) & set(data.seeds)
    solved = held_out.observations[held_out.observation_starts[:, None] + 1 + np.arange(50)][held_out.success.reshape(-1, 50)]
    assert all((example == solved).all(axis=(1, 2, 3)).any() for example in examples)


def test_the_most_even_mix_of_a_share():
    rates = [0.0, 0.1, 0.5, 0.9]
    weights = mix_weights(rates, 0.3)
    assert weights.sum() == pytest.approx(1.0) and weights @ rates == pytest.approx(0.3)
    assert (np.diff(np.log(weights)) / np.diff(rates)).std() < 1e-6  # of the form exp(k * rate)
    np.testing.assert_allclose(mix_weights([0.9, 0.5, 0.5], 0.3), [0.0, 0.5, 0.5], atol=1e-9)


@pytest.mark.parametrize("task", TASKS)
def test_shipped_checkpoints_give_the_papers_shares(task):
    checkpoints = load_policies(POLICIES)[task]
    assert len(checkpoints) >= 2 and all(checkpoint.episodes >= 50 for checkpoint in checkpoints)
    rates = [checkpoint.success_rate for checkpoint in checkpoints]
    assert mix_weights(rates, PAPER_SHARES[task]) @ rates == pytest.approx(PAPER_SHARES[task])


def test_the_same_data_come_out_again(tmp_path):
    sample = OfflineDataset(SAMPLES / "sac_states.h5")
    if (made_with := sample.provenance["versions"]) != installed_versions(SIMULATION_PACKAGES):
        pytest.skip(f"the samples were made with {made_with}")
    path = collect_shard(tmp_path / "again.h5", Collection(4, TASKS, seed=1), progress=False)
    assert content_hash(path) == content_hash(sample)
    assert _same(sample, OfflineDataset(path))


def test_samples_hold_the_same_episodes_as_states_and_as_frames():
    states, frames = (OfflineDataset(SAMPLES / f"sac_{kind}.h5") for kind in ("states", "pixels"))
    assert content_hash(states) == content_hash(frames)
    assert frames.observation_space.shape == (64, 64, 3)
    after_steps = np.delete(states.observations[:], states.step_starts + np.arange(states.n_episodes), axis=0)
    np.testing.assert_array_equal(frames.extras["state"][:], after_steps)
    assert set(success_shares(frames)) == set(TASKS) and min(success_shares(frames).values()) > 0
