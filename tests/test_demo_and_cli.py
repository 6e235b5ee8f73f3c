"""The demo and the command line on small real data."""

import csv
import inspect
import subprocess
import sys
from pathlib import Path
from typing import ClassVar

import gymnasium as gym
import numpy as np
import pytest
from PIL import Image

from sb3_offline import ALGOS, cli
from sb3_offline.benchmark.grid import load_grid
from sb3_offline.commands import COMMANDS
from sb3_offline.common.example_based import ExampleBasedAlgorithm
from sb3_offline.data.reader import OfflineDataset
from sb3_offline.demo.pipeline import METHODS, DemoSettings, run_demo
from sb3_offline.experiment.config import load_config, parse_overrides
from sb3_offline.experiment.evaluation import evaluate_success, success_interval
from sb3_offline.experiment.recording import record_gif

TINY = DemoSettings(
    episodes_per_task=6,
    example_episodes=12,
    judged_episodes=8,
    n_examples=20,
    n_timesteps=4,
    n_curve_points=2,
    n_curve_episodes=1,
    n_final_episodes=2,
)


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo")
    return folder, run_demo(folder, TINY)


def test_demo_leaves_all_its_files(demo):
    folder, report = demo
    with (folder / "results.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["method"] for row in rows] == ["the behaviour itself", *METHODS]
    assert [int(row["episodes"]) for row in rows] == [30, 2, 2, 2]
    assert all(method in report for method in METHODS)
    with Image.open(folder / "policy.gif") as gif:
        assert gif.n_frames > 30 and gif.size == (200, 200)
    for name in ("learning_curve.png", "classifier.png"):
        with Image.open(folder / name) as image:
            assert image.width > 500
    assert sum(1 for _ in (folder / "runs/ceborl/evaluations.csv").open()) == 3


def test_demo_uses_complete_data_again(demo):
    folder, _ = demo
    dataset = next((folder / "data").glob("dataset-*.h5"))
    before = dataset.stat().st_mtime_ns
    from sb3_offline.demo.pipeline import collect

    collect(folder / "data", TINY)
    assert dataset.stat().st_mtime_ns == before and OfflineDataset(dataset).n_episodes == 30


def test_command_line_from_data_to_evaluation(demo, tmp_path, capsys):
    folder, _ = demo
    held_out = str(next((folder / "data").glob("attempts-*-12-*.h5")))
    cli.main(["inspect", held_out])
    assert "drawer-open" in capsys.readouterr().out
    cli.main(["convert", held_out, str(tmp_path / "small.h5"), "--storage", "compressed"])
    cli.main(["examples", str(tmp_path / "small.h5"), "-n", "10", "-o", str(tmp_path / "examples.h5")])
    run = str(tmp_path / "run")
    train = ["train", "--dataset", held_out, "--examples", str(tmp_path / "examples.h5"), "--task", "drawer-open", "-n", "2"]
    cli.main([*train, "--hyperparams", "beta:0.05", "n_action_samples:2", "-o", run])
    assert "beta: 0.05" in (tmp_path / "run/config.yml").read_text()
    capsys.readouterr()
    cli.main(["evaluate", f"{run}/model.zip", "--episodes", "1"])
    assert "of 1 episodes solved" in capsys.readouterr().out
    cli.main(["train", "--algo", "bc", "--dataset", held_out, "-n", "2", "-o", f"{run}-of-all"])
    with pytest.raises(SystemExit, match="no task in particular"):
        cli.main(["evaluate", f"{run}-of-all/model.zip", "--episodes", "1"])

    def files():
        return {file.name: file.read_bytes() for file in (tmp_path / "run").iterdir()}

    before = files()
    train[train.index("--examples") + 1] = "typo.h5"
    with pytest.raises(SystemExit, match=r"typo\.h5"):
        cli.main([*train, "--eval-freq", "1", "-o", run])
    train[train.index("typo.h5")] = str(tmp_path / "examples.h5")
    for wrong, message in ((["--env", "Pendulum-v1"], "do not fit"), (["--hyperparams", "temperature:0"], "temperature is 0")):
        with pytest.raises(SystemExit, match=message):
            cli.main([*train, "--eval-freq", "1", "-o", run, *wrong])
    assert files() == before  # a run stays until the data, the settings and the environment of the next one have been checked
    config = tmp_path / "run/config.yml"
    config.write_text(config.read_text().replace("env: MultimodalMetaworld-v0", "env: Gone-v0"))
    with pytest.raises(SystemExit, match="Gone"):
        cli.main(["evaluate", f"{run}/model.zip", "--episodes", "1"])


@pytest.mark.parametrize("algo", ALGOS)
def test_every_algorithm_trains_with_its_config(algo, demo, tmp_path):
    dataset, examples = (str(next((demo[0] / "data").glob(f"{name}-*.h5"))) for name in ("dataset", "examples"))
    train = ["train", "--algo", algo, "--task", "drawer-open", "--dataset", dataset, "-n", "2", "-o", str(tmp_path)]
    if issubclass(ALGOS[algo], ExampleBasedAlgorithm):
        train += ["--examples", examples]
    if algo == "oril":
        train += ["--hyperparams", "reward_steps:2"]
    cli.main(train)
    model = ALGOS[algo].load(tmp_path / "model.zip")
    assert model.num_timesteps == 2 and model._n_updates == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["inspect", "nowhere.h5"], "nowhere.h5"),
        (["evaluate", "nowhere/model.zip"], r"nowhere/model\.zip: there is no such file"),
        (["train", "--dataset", "x.h5", "-o", "run", "--config", "nothing"], "no such config file.*ceborl_paper"),
        (["train", "--dataset", "x.h5", "-o", "run", "--hyperparams", "beta"], "key:value"),
        (["train", "-o", "run"], "`examples` names 'task'.*--task"),
        (["train", "-o", "run", "--algo", "bc"], r"data/sac_states\.h5: file: does not exist"),
        (["train", "-o", "run", "--env", "Pendulum-v1"], "needs `dataset=`.*--dataset"),
        (["train", "--dataset", "x.h5", "-o", "run", "--algo", "dqn", "--config", "bc"], "no algorithm 'dqn'.*ceborl"),
        (["train", "--dataset", "x.h5", "-o", "run", "--config", "list.yml"], "list.yml: has no sections"),
        (["train", "--dataset", "x.h5", "-o", "run", "--config", "short.yml"], "short.yml: .*lacks n_timesteps"),
        (["train", "--dataset", "x.h5", "-o", "run", "--config", "broken.yml"], "broken.yml: is not YAML"),
        (["train", "--dataset", "x.h5", "-o", "run", "--env", "No-v0", "--eval-freq", "1"], "no environment 'No-v0'"),
        (["train", "--algo", "bc", "--dataset", "x.h5", "-o", "run", "--eval-freq", "1"], "several tasks.*--task"),
        (
            ["train", "--dataset", "x.h5", "-o", "run", "--config", "code.yml"],
            "code.yml: policy_kwargs of Mul.*nn.ReLU.*literal",
        ),
        (["train", "--algo", "bc", "--dataset", "x.h5", "-o", "run", "-n", "0"], "n_timesteps is 0"),
        (["train", "--algo", "bc", "--dataset", "x.h5", "-o", "run", "--eval-episodes", "0"], "n_eval_episodes is 0"),
        (["train", "--dataset", "x.h5", "-o", "run", "--env", "no_module:No-v0", "--eval-freq", "1"], "no_module"),
        (["evaluate", "nowhere/model.zip", "--gif", "gif"], "end it in .gif"),
        (["collect", "out.h5", "--tasks", "door-shut"], "door-shut"),
        (["collect", "short.yml/out.h5"], "short.yml"),
        (["collect-sac", "out.h5", "--episodes-per-task", "1", "--shard", "0/2"], "shards: are 2.*1 episodes"),
    ],
)
def test_mistakes_end_in_one_line(arguments, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code = "default: {policy: MlpPolicy, n_timesteps: 1, policy_kwargs: 'dict(activation_fn=nn.ReLU)', env_kwargs: }"
    texts = {"list": "- 1", "short": "default: {policy: MlpPolicy}", "broken": "a: [", "code": code}
    for name, text in texts.items():
        (tmp_path / f"{name}.yml").write_text(text)
    with pytest.raises(SystemExit, match=f"(?s)sb3-offline: .*{message}"):
        cli.main(arguments)
    assert not list(tmp_path.glob("**/*.h5"))


def test_shipped_configs_are_read_and_overwritten():
    assert load_config("ceborl", "MultimodalMetaworld-v0")["policy"] == "MlpPolicy"
    assert load_config("ceborl_pixels", "MultimodalMetaworld-v0")["env_kwargs"]["obs_type"] == "pixels"
    nested = "policy_kwargs:dict(net_arch=dict(pi=[8], qf=[4]))"
    assert parse_overrides([nested]) == {"policy_kwargs": {"net_arch": {"pi": [8], "qf": [4]}}}
    assert parse_overrides(["tau:0.01", "mu:policy", "policy_kwargs:{'net_arch': [8]}"]) == {
        "tau": 0.01,
        "mu": "policy",
        "policy_kwargs": {"net_arch": [8]},
    }


@pytest.mark.parametrize(("name", "policy"), [("ceborl", "MlpPolicy"), ("ceborl_pixels", "CnnPolicy")])
def test_the_constructors_defaults_are_the_published_settings(name, policy):
    """Four lines of Python give the row of the table: a config says which policy, how long, and where the data are."""
    config = load_config(name, "MultimodalMetaworld-v0")
    assert config.keys() == {"policy", "n_timesteps", "dataset", "examples", "env_kwargs"} and config["policy"] == policy
    for grid in ("second_table_states", "second_table_pixels", "table1_states"):
        assert not load_grid(grid).methods["ceborl"].changes


def test_paper_preset_and_paper_config_are_the_same():
    from sb3_offline.ceborl import CEBORL, PAPER_FORM

    defaults = {name: parameter.default for name, parameter in inspect.signature(CEBORL.__init__).parameters.items()}
    for name, smaller in (("ceborl_paper", {}), ("ceborl_paper_pixels", {"example_batch_size": 64})):
        config = {**defaults, **load_config(name, "MultimodalMetaworld-v0")}
        assert {key: config[key] for key in PAPER_FORM} == {**PAPER_FORM, **smaller}


class Blinks(gym.Env):
    """Reports success at only one step, in the middle of every second episode."""

    observation_space, action_space = gym.spaces.Box(-1, 1, (1,)), gym.spaces.Box(-1, 1, (1,))
    n_episodes = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.n_episodes, self.n_steps = self.n_episodes + 1, 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.n_steps += 1
        solved = self.n_steps == 3 and self.n_episodes % 2 == 1
        return np.zeros(1, np.float32), 0.0, False, self.n_steps == 5, {"is_success": solved}


def test_success_counts_at_any_step():
    gym.register("Blinks-v0", Blinks)
    policy = ALGOS["bc"]("MlpPolicy", Blinks())
    assert evaluate_success(policy, "Blinks-v0", {}, n_episodes=4).successes == [True, False, True, False]
    with pytest.raises(ValueError, match="n_episodes is 0; play at least one"):
        evaluate_success(policy, "Blinks-v0", {}, n_episodes=0)


def test_success_interval_is_wilsons():
    low, high = success_interval(8, 10)
    assert (low, high) == (pytest.approx(0.4902, abs=1e-4), pytest.approx(0.9433, abs=1e-4))
    assert success_interval(0, 20)[0] == 0.0 and 0.15 < success_interval(0, 20)[1] < 0.17


class Still:
    """Does nothing, and keeps the first observation of each episode."""

    def __init__(self, action_shape):
        self.action, self.starts, self.n = np.zeros(action_shape, np.float32), [], 0

    def predict(self, observation, *_, **__):
        if self.n % 5 == 0:
            self.starts.append(observation.flatten())
        self.n += 1
        return self.action, None


class Grey(gym.Env):
    """Renders images of a fixed size."""

    metadata: ClassVar = {"render_modes": ["rgb_array"], "render_fps": 30}
    observation_space = action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, render_mode=None):
        self.render_mode = render_mode

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action):
        return np.zeros(1, np.float32), 0.0, True, False, {}

    def render(self):
        return np.full((20, 30, 3), 128, np.uint8)


def test_any_environment_that_renders_images_is_recorded(tmp_path):
    gym.register("Grey-v0", Grey)
    assert record_gif(Still(1), "Grey-v0", {}, tmp_path / "grey.gif", n_episodes=2) == [False, False]
    with Image.open(tmp_path / "grey.gif") as image:
        assert image.size == (30, 20)
    gym.register("Blind-v0", lambda: Grey())
    with pytest.raises(RuntimeError, match="Blind-v0 renders no images"):
        record_gif(Still(1), "Blind-v0", {}, tmp_path / "blind.gif")


def test_recorded_episodes_are_those_of_the_evaluation(tmp_path):
    env_kwargs = {"task": "door-open", "obs_type": "state", "episode_length": 5}
    evaluated, recorded = Still((1, 4)), Still(4)
    evaluate_success(evaluated, "MultimodalMetaworld-v0", env_kwargs, 2)
    record_gif(recorded, "MultimodalMetaworld-v0", env_kwargs, tmp_path / "still.gif", n_episodes=2, size=16)
    np.testing.assert_array_equal(evaluated.starts, recorded.starts)
    assert not np.array_equal(*evaluated.starts)


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_explains_itself(name, capsys):
    with pytest.raises(SystemExit, match="0"):
        cli.main([name, "--help"])
    text = capsys.readouterr().out
    assert f"usage: sb3-offline {name}" in text
    assert name != "train" or all(algo in text for algo in ALGOS)


def test_the_list_of_commands_imports_no_learner():
    code = """
import sys, types
package = types.ModuleType("sb3_offline")  # without its __init__, which imports the algorithms
package.__path__ = [sys.argv[1]]
sys.modules["sb3_offline"] = package
from sb3_offline.cli import main
try:
    main(["--help"])
finally:
    assert not {"torch", "gymnasium", "sb3_offline.ceborl"} & set(sys.modules)
"""
    command = [sys.executable, "-c", code, str(Path(cli.__file__).parent)]
    assert "collect-sac" in subprocess.run(command, check=True, capture_output=True, text=True).stdout
