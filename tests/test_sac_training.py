"""train-sac and select-sac at a scale of seconds."""

import csv
import json

import numpy as np
import pytest
import torch as th

pytest.importorskip("metaworld")

from stable_baselines3 import SAC

from sb3_offline import cli
from sb3_offline.data.errors import DatasetError
from sb3_offline.data_tools.sac import training
from sb3_offline.data_tools.sac.policies import SacActor, actor_weights, load_policies

SMALL = {
    "learning_starts": 60,
    "buffer_size": 500,
    "batch_size": 16,
    "scaled_states": True,
    "target_entropy": -1.0,
    "ou_noise": (0.2, 0.01),
}


def _train(folder, n_timesteps, *options):
    command = ["train-sac", str(folder), "--tasks", "drawer-open", "-n", str(n_timesteps)]
    cli.main([*command, "--eval-freq", "50", "--eval-episodes", "1", *options])


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setitem(training.SETTINGS, "n_step", {**SMALL, "policy_kwargs": {"net_arch": [8, 6]}})


def test_a_run_that_was_stopped_goes_on_as_if_it_had_not_been(tmp_path, small, capsys):
    _train(tmp_path / "at once", 150)
    _train(tmp_path / "stopped", 50)
    _train(tmp_path / "stopped", 150)
    assert "150 decisions" in capsys.readouterr().out
    for step in (50, 100, 150):
        files = [tmp_path / run / f"drawer-open/policies/{step:06d}.npz" for run in ("at once", "stopped")]
        one, other = (dict(np.load(file)) for file in files)
        assert one.keys() == other.keys()
        assert all((one[name] == other[name]).all() for name in one)
    with (tmp_path / "stopped/drawer-open/curve.csv").open() as file:
        assert [row["step"] for row in csv.DictReader(file)] == ["50", "100", "150"]
    with pytest.raises(SystemExit, match="settings"):
        _train(tmp_path / "stopped", 200, "--settings", "base")
    with pytest.raises(SystemExit, match="seed: is '0' in this run"):
        _train(tmp_path / "stopped", 200, "--seed", "1")
    with pytest.raises(SystemExit, match="eval-freq is 70; give a multiple of 50"):
        _train(tmp_path / "stopped", 200, "--eval-freq", "70")

    (tmp_path / "policies").mkdir()
    (tmp_path / "policies/mine.npz").write_bytes(b"of somebody else")
    command = ["select-sac", str(tmp_path / "stopped"), "-o", str(tmp_path / "policies"), "--checkpoints", "2"]
    cli.main([*command, "--episodes", "2", "--workers", "1"])
    policies = load_policies(tmp_path / "policies")
    assert [(c.step, c.episodes) for c in policies["drawer-open"]] == [(100, 2), (150, 2)]
    entry = json.loads((tmp_path / "policies/policies.json").read_text())["tasks"]["drawer-open"]
    assert entry["runs"]["stopped"]["trained_decisions"] == 150
    assert {"settings", "seed", "commit", "versions"} <= entry["runs"]["stopped"].keys()
    cli.main([*command, "--episodes", "2", "--workers", "1", "--checkpoints", "1"])
    names = {path.name for path in (tmp_path / "policies").iterdir()}
    assert names == {"drawer-open_stopped_000150.npz", "mine.npz", "policies.json"}
    with pytest.raises(SystemExit, match="name: is not unique among stopped, stopped"):
        cli.main([*command[:2], str(tmp_path / "other/stopped"), *command[2:]])
    policies = load_policies(tmp_path / "policies")
    policies["drawer-open"][0].file.write_bytes(b"others")
    with pytest.raises(DatasetError, match="sha256"):
        load_policies(tmp_path / "policies")


def test_training_ends_when_two_evaluations_in_a_row_are_good():
    def curve(*successes):
        return [{"step": str(i * 50), "successes": str(n), "episodes": "20"} for i, n in enumerate(successes, start=1)]

    assert training._is_done(curve(0, 18, 20), 1000)
    assert not training._is_done(curve(18, 0, 20), 1000)
    assert not training._is_done(curve(18), 1000) and training._is_done(curve(0, 0), 100)


def test_the_actor_in_numpy_is_that_of_sb3():
    env = training.gym.make(training.ENV_ID, obs_type="state")
    model = SAC("MlpPolicy", env, policy_kwargs={"net_arch": [16, 12]}, buffer_size=1, seed=0, device="cpu")
    offset, scale = training._state_scaling(env)
    actor = SacActor(actor_weights({name: p.numpy() for name, p in model.actor.state_dict().items()}, offset, scale))
    states = np.stack([env.reset(seed=i)[0] for i in range(3)])
    scaled = ((states - offset) / scale).astype(np.float32)
    expected = model.predict(scaled, deterministic=True)[0]
    np.testing.assert_allclose([actor.act(state) for state in states], expected, atol=1e-5)

    rng = np.random.default_rng(0)
    sampled = np.arctanh(np.stack([actor.act(states[0], rng) for _ in range(4000)]).astype(np.float64))
    with th.no_grad():
        mean, log_std, _ = model.actor.get_action_dist_params(th.as_tensor(scaled[:1]))
    np.testing.assert_allclose(sampled.mean(axis=0), mean[0], atol=0.08)
    np.testing.assert_allclose(sampled.std(axis=0), log_std[0].exp(), rtol=0.06)
