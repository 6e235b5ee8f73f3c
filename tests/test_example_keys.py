"""Success that is shown by some keys of dict observations only: photographs beside a robot's joints."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from data_files import BOTH, IMAGES, STATES, make_observations, write_dataset
from gymnasium import spaces
from PIL import Image
from point_mass import ACTIONS, GOALS, N_STEPS, SPEED, PointMass, goal_examples
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_offline import CEBORL, DCQL, ORIL, RCE, cli
from sb3_offline.common.online import export_sac
from sb3_offline.common.stub_env import SpacesOnlyEnv
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.examples import load_examples, save_examples
from sb3_offline.data.reader import OfflineDataset
from sb3_offline.data.writer import DatasetWriter
from sb3_offline.evaluation import OfflineEvalCallback
from sb3_offline.experiment.evaluation import evaluate_success
from sb3_offline.experiment.training import load_run

FRAMES = make_observations(IMAGES, 5, np.random.default_rng(0))
VECTORS = make_observations(STATES, 5, np.random.default_rng(1))
ROBOT = spaces.Dict({"image": spaces.Box(0, 255, (36, 40, 3), np.uint8), "joints": STATES})
SMALL = {"net_arch": [16, 16], "features_extractor_kwargs": {"cnn_output_dim": 16}}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A dataset of images and joints, and a folder of images of success."""
    path = tmp_path_factory.mktemp("robot")
    write_dataset(path / "robot.h5", 6, ROBOT)
    (path / "success").mkdir()
    for i, frame in enumerate(make_observations(ROBOT["image"], 5, np.random.default_rng(2))):
        Image.fromarray(frame).save(path / "success" / f"{i}.png")
    return path


def make(algorithm, folder, **kwargs):
    few = {CEBORL: {"example_batch_size": 4}, RCE: {"example_batch_size": 4}, ORIL: {"reward_steps": 3}}.get(algorithm, {})
    given = {"dataset": str(folder / "robot.h5"), "examples": str(folder / "success"), "batch_size": 8, "seed": 0}
    return algorithm("MultiInputPolicy", **{**given, "policy_kwargs": SMALL, "random_shift": 2, **few, **kwargs})


def test_which_keys_the_examples_have(tmp_path):
    for i, frame in enumerate(FRAMES):
        Image.fromarray(frame).save(tmp_path / f"{i}.png")
    np.savez(tmp_path / "some.npz", image=FRAMES)
    np.savez(tmp_path / "one.npz", observations=FRAMES)
    np.save(tmp_path / "state.npy", VECTORS)
    save_examples(tmp_path / "all.h5", {"image": FRAMES, "state": VECTORS}, BOTH)
    turned = spaces.Dict({"image": spaces.Box(0, 255, (3, 8, 6), np.uint8), "state": STATES})
    for source in (tmp_path, tmp_path / "some.npz", tmp_path / "one.npz", FRAMES, {"image": FRAMES}, {"image": tmp_path}):
        found = load_examples(source, turned)
        assert list(found) == ["image"]
        np.testing.assert_array_equal(found["image"], FRAMES.transpose(0, 3, 1, 2))
    assert list(load_examples(tmp_path / "state.npy", BOTH)) == ["state"]
    both = load_examples({"state": tmp_path / "state.npy", "image": str(tmp_path)}, BOTH)
    np.testing.assert_array_equal(both["image"], FRAMES)
    np.testing.assert_array_equal(both["state"], VECTORS)
    assert list(load_examples(tmp_path / "all.h5", BOTH, ["state"])) == ["state"]  # the others are left out

    two = spaces.Dict({"front": IMAGES, "wrist": IMAGES, "state": STATES})
    assert list(load_examples(tmp_path, two, ["wrist"])) == ["wrist"]
    for source, space, message in [
        (tmp_path, two, r"hold images, which may belong to any of \['front', 'wrist'\].*example_keys"),
        (FRAMES, two, r"which may belong to any of \['front', 'wrist'\]"),
        (FRAMES[:, :4], BOTH, r"hold one array of shape \(5, 4, 6, 3\), which fit no key of"),
        ({"picture": FRAMES, "state": VECTORS}, BOTH, r"has no \['picture'\]. Name the arrays.*'image', 'state'"),
        ({"image": FRAMES, "state": VECTORS[:4]}, BOTH, "holds 4 examples, but other keys hold 5"),
    ]:
        with pytest.raises(DatasetError, match=message):
            load_examples(source, space)


def batch_of(folder_or_model, n=6):
    return folder_or_model.replay_buffer.transitions(np.arange(n)).observations


def with_other(observations, key):
    return {**observations, key: observations[key].flip(0)}


@pytest.mark.parametrize("algorithm", [CEBORL, RCE, ORIL, DCQL])
def test_success_is_known_by_the_keys_of_the_examples_and_the_policy_sees_all(algorithm, folder, tmp_path):
    model = make(algorithm, folder).learn(3)
    assert model.example_keys == ["image"]
    seen = batch_of(model)
    actions = th.zeros(6, 2)
    moved, redrawn = with_other(seen, "joints"), with_other(seen, "image")
    if algorithm is not DCQL:
        judged = model.success_probabilities(seen, actions)
        assert th.equal(model.success_probabilities(moved, actions), judged)
        assert not th.equal(model.success_probabilities(redrawn, actions), judged)
        assert model.success_probabilities(model.all_examples()).shape == (5,)
    # Q-values of rewards see everything; a classifier of success is the value of CEBORL and RCE
    assert th.equal(model.values(moved, actions), model.values(seen, actions)) == (algorithm in (CEBORL, RCE))
    for other in (moved, redrawn):
        assert not np.array_equal(*(model.predict(_numpy(o), deterministic=True)[0] for o in (seen, other)))

    model.save(tmp_path / "model")
    model.learn(2, reset_num_timesteps=False)
    loaded = algorithm.load(tmp_path / "model")
    assert loaded.example_keys == ["image"]
    loaded.learn(2, reset_num_timesteps=False)
    for name, value in model.policy.state_dict().items():
        assert th.equal(loaded.policy.state_dict()[name], value), name
    if algorithm is DCQL:
        rewards = model.replay_buffer.rewards.copy()
        model.replay_buffer._stores["observations/joints"].parts[0][:] += 1
        model.relabel(model.replay_buffer)
        np.testing.assert_array_equal(model.replay_buffer.rewards, rewards)


def _numpy(observations):
    return {key: value.numpy() for key, value in observations.items()}


@pytest.mark.parametrize(
    "form", [{}, {"backup": "expectile"}, {"backup": "policy", "policy_extraction": "maximize", "mu": "mixture"}]
)
def test_all_forms_of_the_classifier_learn_from_some_keys(form, folder):
    model = make(CEBORL, folder, example_share=0.1, **form)
    evaluation = OfflineEvalCallback(examples=str(folder / "success"), eval_freq=2, n_transitions=8)
    model.learn(2, callback=[evaluation, *model.default_callbacks()])
    assert 0 <= evaluation.evaluate()["examples_auc"] <= 1
    [watcher] = model.default_callbacks()
    watcher.init_callback(model)
    assert 0 <= watcher.measure()["data_like_examples"] <= 1


def test_all_keys_learn_as_if_they_were_not_named(folder):
    examples = {"image": load_examples(folder / "success", ROBOT)["image"], "joints": VECTORS}
    weights = [
        make(CEBORL, folder, examples=examples, **named).learn(2).policy.state_dict()
        for named in ({}, {"example_keys": ["joints", "image"]})
    ]
    assert all(th.equal(value, weights[1][name]) for name, value in weights[0].items())
    only_images = make(CEBORL, folder, examples=examples, example_keys="image")
    assert only_images.example_keys == ["image"] and list(only_images.all_examples()) == ["image"]


def test_what_is_refused(folder):
    with pytest.raises(TypeError, match=r"the critics see \['image'\] only.*share_features_extractor=False"):
        make(CEBORL, folder, policy_kwargs={**SMALL, "share_features_extractor": True})
    with pytest.raises(TypeError, match=r"example_keys is \['picture'\]; give some of .*'image', 'joints'"):
        make(ORIL, folder, example_keys=["picture"])
    with pytest.raises(TypeError, match=r"example_keys is .*, but observations have no keys"):
        DCQL("MlpPolicy", SpacesOnlyEnv(STATES, ACTIONS), example_keys=["image"])
    with pytest.raises(DatasetError, match=r"hold \['image'\] and lack \['joints'\]"):
        make(RCE, folder, example_keys=["image", "joints"]).learn(1)


def test_statistics_of_a_normalised_environment_apply_to_the_keys_that_examples_have(folder):
    vectors = spaces.Dict({"joints": STATES, "touch": STATES})
    write_dataset(folder / "vectors.h5", 6, vectors)
    env = VecNormalize(
        DummyVecEnv(
            [lambda: SpacesOnlyEnv(vectors, spaces.Box(np.array([-2.0, 0], np.float32), np.array([2.0, 10], np.float32)))]
        )
    )
    model = make(
        CEBORL,
        folder,
        env=env,
        dataset=str(folder / "vectors.h5"),
        examples={"touch": VECTORS},
        random_shift=0,
        policy_kwargs={"net_arch": [16]},
    )
    model.learn(1)
    expected = env.normalize_obs({"joints": VECTORS, "touch": VECTORS})["touch"]
    np.testing.assert_array_equal(model.all_examples()["touch"].numpy(), expected)


def test_an_export_to_sac_acts_alike_and_its_critics_see_everything(folder, tmp_path):
    from stable_baselines3 import SAC

    env = SpacesOnlyEnv(ROBOT, spaces.Box(np.array([-2.0, 0], np.float32), np.array([2.0, 10], np.float32)))
    model = make(CEBORL, folder, env=env).learn(1)
    export_sac(model, tmp_path / "sac")
    sac = SAC.load(tmp_path / "sac", env=env)
    seen = batch_of(model)
    np.testing.assert_array_equal(
        sac.predict(_numpy(seen), deterministic=True)[0], model.predict(_numpy(seen), deterministic=True)[0]
    )
    values = sac.critic(seen, th.zeros(6, 2))[0]
    assert not th.equal(sac.critic(with_other(seen, "joints"), th.zeros(6, 2))[0], values)


class MirroredPointMass(PointMass):
    """A point mass whose actions act mirrored in half of the episodes; `mirror` shows it, and no example of success does."""

    observation_space = spaces.Dict({"mirror": spaces.Box(-1, 1, (1,), np.float32), "place": PointMass.observation_space})

    def reset(self, *, seed=None, options=None):
        place, info = super().reset(seed=seed)
        self.mirror = np.float32(self.np_random.choice([-1, 1]))
        return self._seen(place), info

    def step(self, action):
        place, *rest = super().step(self.mirror * action)
        return self._seen(place), *rest

    def _seen(self, place):
        return {"mirror": np.array([self.mirror]), "place": place}


gym.register("TestMirroredPointMass-v0", entry_point=MirroredPointMass)


def test_ceborl_learns_from_examples_that_do_not_show_all_that_the_policy_needs(tmp_path):
    rng, env = np.random.default_rng(0), MirroredPointMass()
    with DatasetWriter(tmp_path / "data.h5", env.observation_space, ACTIONS, rewards=False, success=False) as writer:
        for index in range(400):
            goal, gives_up = GOALS[rng.integers(len(GOALS))], rng.integers(3, 2 * N_STEPS)
            observations, actions = [env.reset(seed=index)[0]], []
            for t in range(N_STEPS):
                direction = (goal - observations[-1]["place"]) / SPEED if t < gives_up else np.zeros(2)
                meant = np.clip(direction, -0.7, 0.7) + 0.3 * rng.normal(size=2)
                actions.append(np.clip(env.mirror * meant, -1, 1).astype(np.float32))
                observations.append(env.step(actions[-1])[0])
            rows = {key: np.stack([observation[key] for observation in observations]) for key in env.observation_space}
            writer.add_episode(rows, np.stack(actions))
    model = CEBORL(
        "MultiInputPolicy",
        "TestMirroredPointMass-v0",
        str(tmp_path / "data.h5"),
        {"place": goal_examples()},
        n_action_samples=4,
        seed=0,
        policy_kwargs={"net_arch": [64, 64]},
    ).learn(600)
    assert evaluate_success(model, "TestMirroredPointMass-v0", {"goal": 0}, 20).success_rate >= 0.9


def test_the_table_with_images_and_hand_is_learned_from_images_of_success(tmp_path, monkeypatch, capsys):
    pytest.importorskip("metaworld")
    from stable_baselines3.common.env_checker import check_env

    from sb3_offline.data_tools.converting.render_dataset import render_dataset

    monkeypatch.chdir(tmp_path)
    env = gym.make("MultimodalMetaworld-v0", task="drawer-open", obs_type="both", frame_size=40)
    check_env(env.unwrapped)
    env.close()
    collect = ["--episodes-per-task", "1", "--tasks", "drawer-open", "--seed", "2", "--workers", "1"]
    cli.main(["collect", "both.h5", "--obs-type", "both", *collect])
    cli.main(["collect", "states.h5", "--obs-type", "state", *collect])
    render_dataset("states.h5", "drawn.h5", obs_type="both", n_workers=1, progress=False)
    collected, drawn = OfflineDataset("both.h5"), OfflineDataset("drawn.h5")
    assert collected.observation_space == drawn.observation_space and collected.env_kwargs["obs_type"] == "both"
    for name in collected.arrays:
        np.testing.assert_array_equal(collected.arrays[name], drawn.arrays[name])

    cli.main(["examples", "both.h5", "-o", "images.h5", "-n", "3", "--keys", "image"])
    assert list(load_examples("images.h5", collected.observation_space)) == ["image"]
    cli.main(["inspect", "both.h5", "--examples", "images.h5", "--html", "page.html"])
    assert "3 examples" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        cli.main(["examples", "both.h5", "-o", "other.h5", "-n", "3", "--keys", "picture"])
    options = ["--dataset", "both.h5", "--examples", "images.h5", "--task", "drawer-open", "-n", "2", "--output", "run"]
    cli.main(["train", "--config", "ceborl_both", *options, "--hyperparams", "batch_size:4"])
    model, config = load_run(tmp_path / "run" / "model.zip")
    assert model.example_keys == ["image"] and config["env_kwargs"] == {"obs_type": "both", "task": "drawer-open"}
    assert len(evaluate_success(model, config["env"], {**config["env_kwargs"], "episode_length": 2}, 1).successes) == 1
