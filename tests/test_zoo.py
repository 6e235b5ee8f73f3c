"""The real rl_zoo3 on offline algorithms: its own train, enjoy and Optuna code, on small data."""

import csv
import os
import sys

import gymnasium as gym
import numpy as np
import pytest
import yaml
from data_files import STATES, make_observations, write_dataset
from point_mass import PointMass, goal_examples, write_point_mass

pytest.importorskip("rl_zoo3", reason='rl_zoo3 is not installed: pip install -e ".[zoo]"')

import optuna
import rl_zoo3
from rl_zoo3.enjoy import enjoy
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_offline import ALGOS, CEBORL
from sb3_offline.common.example_based import ExampleBasedAlgorithm
from sb3_offline.data.examples import save_examples
from sb3_offline.data.reader import OfflineDataset
from sb3_offline.data.writer import DatasetWriter
from sb3_offline.experiment.config import config_path, load_config
from sb3_offline.experiment.training import create_model
from sb3_offline.labelling import classifier
from sb3_offline.zoo import train
from sb3_offline.zoo.manager import OfflineExperimentManager

ENV_ID = "MultimodalMetaworld-v0"
CONFIG = """
TestZoo-v0:
  policy: MlpPolicy
  n_timesteps: 6
  dataset: points.h5
  examples: goal_{goal}.npy
  env_kwargs: {goal: 1, colour: blue}
  batch_size: 8
  policy_kwargs: dict(net_arch=[8], n_critics=3)
  normalize: true
  learning_rate: 3e-4
"""
TRAIN = "--algo ceborl --env TestZoo-v0 --conf-file my.yml --env-kwargs goal:2 --seed 1 --eval-episodes 2".split()


class Watched(PointMass):
    """Says what it was made with."""

    made: list = []  # noqa: RUF012

    def __init__(self, goal=0, colour="red"):
        super().__init__(goal)
        self.made.append((goal, colour))


gym.register("TestZoo-v0", entry_point=Watched)


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Runs a program in a folder with a small dataset, examples of two goals and a config."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(HYPERPARAMS_SAMPLER, "ceborl", HYPERPARAMS_SAMPLER["ceborl"])  # a study adds a config's policy_kwargs
    write_point_mass("points.h5", n_episodes=10)
    write_dataset(tmp_path / "others.h5", 3, STATES)
    for goal in (1, 2):
        np.save(f"goal_{goal}.npy", goal_examples(5, goal))
    (tmp_path / "my.yml").write_text(CONFIG)

    def run(program, *arguments):
        monkeypatch.setattr(sys, "argv", ["program", *arguments])
        program()

    return run


def test_train_and_enjoy(run, tmp_path, capsys):
    Watched.made.clear()
    run(train.main, *TRAIN, "--eval-freq", "3", "--save-freq", "3")
    assert Watched.made == [(2, "blue")] * 2  # to learn in, and to evaluate in

    folder = tmp_path / "logs/ceborl/TestZoo-v0_1"
    assert CEBORL.load(folder / "rl_model_3_steps.zip")._n_updates == 3
    assert CEBORL.load(folder / "TestZoo-v0.zip")._n_updates == 6 and (folder / "best_model.zip").is_file()
    evaluations = np.load(folder / "evaluations.npz")
    assert evaluations["timesteps"].tolist() == [3, 6] and evaluations["successes"].shape == (2, 2)
    config = yaml.unsafe_load((folder / "TestZoo-v0/config.yml").read_text())
    assert config["examples"] == "goal_{goal}.npy" and config["env_kwargs"] == {"goal": 2, "colour": "blue"}
    scale = VecNormalize.load(str(folder / "TestZoo-v0/vecnormalize.pkl"), DummyVecEnv([PointMass])).obs_rms
    dataset = OfflineDataset("points.h5")
    np.testing.assert_allclose(scale.var, np.var(dataset.observations, axis=0), rtol=0.1)

    Watched.made.clear()
    capsys.readouterr()
    for which in ("--load-best", "--load-last-checkpoint"):
        run(enjoy, *TRAIN[:4], "-f", "logs", "--no-render", "-n", "45", which)
        printed = capsys.readouterr().out
        assert "Loading running average" in printed and "Success rate" in printed and "2 Episodes" in printed
    assert Watched.made == [(2, "blue")] * 2

    run(train.main, *TRAIN, "-n", "2", "--eval-freq", "-1", "-i", str(folder / "TestZoo-v0.zip"))
    assert CEBORL.load(folder.with_name("TestZoo-v0_2") / "TestZoo-v0.zip")._n_updates == 8


def test_optuna_study(run, tmp_path):
    study = "-optimize --n-trials 3 --n-startup-trials 1 --n-evaluations 2 --pruner none --no-optim-plots --eval-freq 1"
    stored = ["--storage", "study.log", "--study-name", "mine"]
    run(train.main, *TRAIN, "-n", "4", *study.split(), *stored)
    with next((tmp_path / "logs/ceborl").glob("report_*.csv")).open() as file:
        rows = list(csv.DictReader(file))
    assert [row["state"] for row in rows] == ["COMPLETE"] * 3 and len({row["params_beta"] for row in rows}) == 3

    run(train.main, *TRAIN, "-n", "1", "--eval-freq", "-1", *stored, "--trial-id", "2")
    latest = max((tmp_path / "logs/ceborl").glob("TestZoo-v0_*/TestZoo-v0.zip"))
    model = CEBORL.load(latest)
    assert model.beta == float(rows[2]["params_beta"])
    sampled = HYPERPARAMS_SAMPLER["ceborl"](optuna.create_study().ask(), 2, 1, {})
    written = yaml.unsafe_load((latest.parent / "TestZoo-v0/config.yml").read_text())
    assert written["policy_kwargs"] == {name: model.policy_kwargs[name] for name in written["policy_kwargs"]}
    # What the config says, with another network
    for policy_kwargs in (model.policy_kwargs, sampled["policy_kwargs"], written["policy_kwargs"]):
        assert policy_kwargs["n_critics"] == 3 and policy_kwargs["net_arch"] != [8]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["-optimize", "--hyperparams", "dataset:'nowhere.h5'"], r"nowhere\.h5: file: does not exist"),
        (["-optimize", "--hyperparams", "dataset:'others.h5'", "examples:'others.npy'"], "the learner has"),
        (["-optimize", "--env-kwargs", "goal:3"], r"goal_3\.npy"),
        (["--hyperparams", "dataset:None"], r"my\.yml: names no dataset for TestZoo-v0.*--hyperparams"),
        (["--hyperparams", "dataset:'{place}.h5'"], "`dataset` names 'place'.*--env-kwargs"),
        (["--hyperparams", "learning_rate:'lin'"], "not enough values|lin"),
        (["--hyperparams", "betaa:1"], "ceborl: .*'betaa'; check the config and --hyperparams"),
        (["--conf-file", "nothing.yml"], r"nothing\.yml"),
    ],
)
def test_mistakes_end_in_one_line_and_prune_nothing(run, arguments, message):
    np.save("others.npy", make_observations(STATES, 4, np.random.default_rng(0)))
    with pytest.raises(SystemExit, match=rf"(?s)^sb3_offline\.zoo\.train: .*{message}"):
        run(train.main, *TRAIN, "-n", "2", "--n-trials", "2", "--eval-freq", "-1", *arguments)


@pytest.mark.parametrize("algo", ALGOS)
def test_sampled_hyperparameters_make_a_model_that_learns(algo, tmp_path):
    assert rl_zoo3.ALGOS[algo] is ALGOS[algo]
    write_dataset(tmp_path / "d.h5", 6, STATES)
    data = {"dataset": str(tmp_path / "d.h5"), "device": "cpu"}
    if issubclass(ALGOS[algo], ExampleBasedAlgorithm):
        data["examples"] = make_observations(STATES, 4, np.random.default_rng(0))
    if algo == "oril":
        data["reward_steps"] = 2
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    for _ in range(3):
        trial = study.ask()
        sampled = HYPERPARAMS_SAMPLER[algo](trial, 2, 1, {"using_her_replay_buffer": False, "her_kwargs": {}})
        assert HYPERPARAMS_CONVERTER[algo](trial.params) == sampled
        model = ALGOS[algo]("MlpPolicy", None, **data, **sampled).learn(2)
        assert sampled.pop("policy_kwargs").items() <= model.policy_kwargs.items()
        assert {name: getattr(model, name) for name in sampled} == sampled


def write_shipped_data(kind, env):
    """Random data where the shipped configs look for them; the first two of three attempts at each task succeed."""
    rng, sources = np.random.default_rng(0), ["door-open", "drawer-open"]
    # Images alone show success to a robot that sees its hand as well
    shown, space = ("pixels", env.observation_space["image"]) if kind == "both" else (kind, env.observation_space)
    os.makedirs(f"data/sac_{shown}_examples")
    with DatasetWriter(
        f"data/sac_{kind}.h5", env.observation_space, env.action_space, sources=sources, rewards=False
    ) as writer:
        for index in range(6):
            observations, actions = make_observations(env.observation_space, 4, rng), rng.uniform(-1, 1, (3, 4))
            writer.add_episode(observations, actions, success=[False, False, index < 4], source=sources[index % 2])
    save_examples(f"data/sac_{shown}_examples/drawer-open.h5", make_observations(space, 3, rng), space)


@pytest.mark.parametrize("name", sorted(file.stem for file in config_path("ceborl").parent.glob("*.yml")))
def test_shipped_configs_mean_the_same_to_rl_zoo3(name, run, monkeypatch):
    algo = next(algo for algo in sorted(ALGOS, key=len, reverse=True) if name.startswith(algo))
    config = load_config(name, ENV_ID)
    config["env_kwargs"] = {**config["env_kwargs"], "task": "drawer-open"}
    few: dict = {"reward_steps": 2} if algo == "oril" else {"batch_size": 4}
    if name.startswith("bc_detected"):
        few["episodes"] = {"detected": 3}  # in random data, none may be detected
        monkeypatch.setattr(classifier, "VECTOR_STEPS", 2)
        monkeypatch.setattr(classifier, "IMAGE_STEPS", 2)
    kind = name.rpartition("_")[2]
    write_shipped_data(kind if kind in ("pixels", "both") else "states", gym.make(ENV_ID, **config["env_kwargs"]))

    models = []
    monkeypatch.setattr(OfflineExperimentManager, "learn", lambda self, model: models.append(model))
    overrides = [f"{key}:{value}" for key, value in few.items()]
    arguments = ["--algo", algo, "--env", ENV_ID, "--conf-file", name, "--env-kwargs", "task:'drawer-open'", "--seed", "0"]
    run(train.main, *arguments, "--hyperparams", *overrides)
    theirs, ours = models[0], create_model(algo, {**config, **few})

    assert theirs.policy_class is ours.policy_class and theirs.observation_space == ours.observation_space
    assert theirs.lr_schedule(1) == ours.lr_schedule(1)  # rl_zoo3 makes a schedule of a number
    others = {"policy", "n_timesteps", "env_kwargs", "episodes", "dataset", "learning_rate"}
    for key in (config.keys() | {"examples"}) - others:
        assert getattr(theirs, key, None) == getattr(ours, key, None), key
    for key in ("actions", "rewards"):
        np.testing.assert_allclose(getattr(theirs.replay_buffer, key), getattr(ours.replay_buffer, key), rtol=1e-5)
    n_steps = 6 if name.startswith("bc_filtered") else 9 if "episodes" in config else 18
    assert len(theirs.replay_buffer.actions) == n_steps
    assert (theirs.replay_buffer.rewards.sum() == 2) == (config.get("reward_fn") == "success")
