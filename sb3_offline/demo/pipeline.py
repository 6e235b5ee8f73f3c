"""The whole demo: from nothing to trained policies and a report in one folder."""

import csv
import json
import platform
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

import sb3_offline
from sb3_offline.ceborl.classifier import RecursiveClassifier
from sb3_offline.data.examples import save_examples
from sb3_offline.data.files import replacing
from sb3_offline.data.reader import OfflineDataset
from sb3_offline.data_tools.collecting.scripted import BEHAVIOUR, TASKS, collect_scripted
from sb3_offline.data_tools.converting.extract_examples import extract_examples
from sb3_offline.demo import plots
from sb3_offline.demo.trajectories import judge_trajectories, pick_trajectories
from sb3_offline.envs import ENV_ID
from sb3_offline.experiment.config import load_config
from sb3_offline.experiment.evaluation import evaluate_success, success_interval
from sb3_offline.experiment.parallel_training import train_in_parallel
from sb3_offline.experiment.recording import record_gif
from sb3_offline.experiment.run import MODEL_FILE, TrainingRun
from sb3_offline.experiment.training import load_run

#: Rows of the table: algorithm and config by label.
METHODS = {
    "CEBORL": ("ceborl", "ceborl"),
    "CEBORL, the paper's form": ("ceborl", "ceborl_paper"),
    "BC on the same data": ("bc", "bc"),
}
RESULT_FIELDS = ("method", "task", "obs_type", "seed", "steps", "episodes", "successes", "low", "high")


@dataclass(frozen=True)
class DemoSettings:
    """
    The settings of a demo.

    :param task: the task to learn
    :param obs_type: "state" or "pixels"
    :param episodes_per_task: number of attempts at each of the five tasks in the unlabelled dataset
    :param example_episodes: number of further attempts at the task, from which the examples are drawn
    :param judged_episodes: number of further attempts, which no method learns from, for the figure of the classifier
    :param n_examples: number of success examples
    :param n_timesteps: gradient steps of each method (default: those of the configs)
    :param n_curve_points: number of evaluations along each run
    :param n_curve_episodes: number of episodes in each of these
    :param n_final_episodes: number of episodes that each final policy plays
    :param methods: some of :data:`METHODS`
    :param seed: seed of the data and the runs
    :param n_workers: number of processes, with one thread each
    """

    task: str = "drawer-open"
    obs_type: str = "state"
    episodes_per_task: int = 300
    example_episodes: int = 80
    judged_episodes: int = 40
    n_examples: int = 200
    n_timesteps: int | None = None
    n_curve_points: int = 6
    n_curve_episodes: int = 20
    n_final_episodes: int = 50
    methods: tuple[str, ...] = tuple(METHODS)
    seed: int = 0
    n_workers: int = 2


def run_demo(output: Path, settings: DemoSettings) -> str:
    """
    Collect, train, evaluate and report. Complete data of an earlier demo are used again.

    :param output: folder, which is created; ``report.md`` in it shows the results
    :param settings: the settings
    :return: text of the report
    """
    began = time.monotonic()
    data = collect(output / "data", settings)
    runs = {method: training_run(method, output, data, settings) for method in settings.methods}
    print(f"Training {', '.join(runs)}")
    train_in_parallel(runs, settings.n_workers)

    env_kwargs = {"task": settings.task, "obs_type": settings.obs_type}
    rows = [behaviour_row(data["dataset"], settings)]
    for method, run in runs.items():
        model, config = load_run(run.output / MODEL_FILE, trust=True)
        print(f"Playing {settings.n_final_episodes} episodes of {method}")
        result = evaluate_success(model, ENV_ID, env_kwargs, settings.n_final_episodes)
        rows.append(result_row(method, settings, config["n_timesteps"], settings.n_final_episodes, sum(result.successes)))
        if method == "CEBORL":
            print("Recording the policy and its classifier")
            assert isinstance(model, RecursiveClassifier)
            record_gif(model, ENV_ID, env_kwargs, output / "policy.gif")
            judged = judge_trajectories(model, OfflineDataset(data["judged"]))
            plots.plot_classifier(judged, pick_trajectories(judged), output / "classifier.png")
    plots.plot_learning_curves({method: run.output for method, run in runs.items()}, output / "learning_curve.png")
    with (output / "results.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, RESULT_FIELDS)
        writer.writeheader()
        writer.writerows(rows)
    return write_demo_report(output, settings, rows, time.monotonic() - began)


def training_run(method: str, output: Path, data: dict[str, Path], settings: DemoSettings) -> TrainingRun:
    """
    :param method: one of :data:`METHODS`
    :param output: folder of the demo
    :param data: files from :func:`collect`
    :param settings: the settings
    :return: the training run of this method
    """
    algo, config_name = METHODS[method]
    config = load_config(config_name + ("_pixels" if settings.obs_type == "pixels" else ""), ENV_ID)
    if settings.n_timesteps:
        config["n_timesteps"] = settings.n_timesteps
    return TrainingRun(
        algo,
        ENV_ID,
        config,
        output / "runs" / config_name,
        dataset=str(data["dataset"]),
        examples=None if algo == "bc" else str(data["examples"]),
        env_kwargs={"task": settings.task},
        seed=settings.seed,
        eval_freq=max(config["n_timesteps"] // settings.n_curve_points, 1),
        n_eval_episodes=settings.n_curve_episodes,
    )


def collect(folder: Path, settings: DemoSettings) -> dict[str, Path]:
    """
    Collect the data, unless they are complete from an earlier demo.

    :param folder: folder for the files
    :param settings: the settings
    :return: paths of the files: ``dataset`` (which learners see without labels), ``examples`` and ``judged``
    """
    folder.mkdir(parents=True, exist_ok=True)
    # The names tell the settings, so that a demo with other settings does not use these files.
    stem = f"{settings.obs_type}-{settings.episodes_per_task}-seed{settings.seed}"
    source_stem = f"{settings.obs_type}-{settings.task}-{settings.example_episodes}-seed{settings.seed + 1}"
    judged_stem = f"{settings.obs_type}-{settings.task}-{settings.judged_episodes}-seed{settings.seed + 2}"
    source = folder / f"attempts-{source_stem}.h5"
    paths = {
        "dataset": folder / f"dataset-{stem}.h5",
        "examples": folder / f"examples-{source_stem}-{settings.n_examples}.h5",
        "judged": folder / f"attempts-{judged_stem}.h5",
    }
    print(f"Collecting {len(TASKS) * settings.episodes_per_task} episodes: {BEHAVIOUR}")
    _collect_once(paths["dataset"], settings.episodes_per_task, TASKS, settings.obs_type, settings.seed)
    print(f"Collecting {settings.example_episodes} further attempts at {settings.task} for success examples")
    _collect_once(source, settings.example_episodes, (settings.task,), settings.obs_type, settings.seed + 1)
    print(f"Collecting {settings.judged_episodes} further attempts for the figure of the classifier")
    _collect_once(paths["judged"], settings.judged_episodes, (settings.task,), settings.obs_type, settings.seed + 2)
    examples, provenance = extract_examples(source, settings.n_examples, seed=settings.seed, held_out=True)
    save_examples(paths["examples"], examples, OfflineDataset(source).observation_space, provenance)
    return paths


def _collect_once(path: Path, episodes_per_task: int, tasks: tuple[str, ...], obs_type: str, seed: int) -> None:
    if not path.exists() or OfflineDataset(path).n_episodes < episodes_per_task * len(tasks):
        collect_scripted(path, episodes_per_task=episodes_per_task, tasks=tasks, obs_type=obs_type, seed=seed, mode="w")


def behaviour_row(dataset: Path, settings: DemoSettings) -> dict[str, Any]:
    """
    :param dataset: the dataset to learn from
    :param settings: the settings
    :return: the row of the behaviour policy: how often the collected episodes solve the task, as a perfect imitation would
    """
    data = OfflineDataset(dataset)
    solved = np.logical_or.reduceat(data.extras["task_success"][:, TASKS.index(settings.task)], data.step_starts)
    return result_row("the behaviour itself", settings, 0, data.n_episodes, int(solved.sum()))


def result_row(method: str, settings: DemoSettings, steps: int, episodes: int, successes: int) -> dict[str, Any]:
    """:return: a row with the columns :data:`RESULT_FIELDS`"""
    low, high = success_interval(successes, episodes)
    values = (
        method,
        settings.task,
        settings.obs_type,
        settings.seed,
        steps,
        episodes,
        successes,
        round(low, 3),
        round(high, 3),
    )
    return dict(zip(RESULT_FIELDS, values, strict=True))


def result_table(rows: list[dict[str, Any]]) -> str:
    """
    :param rows: rows of ``results.csv``
    :return: a Markdown table
    """
    lines = ["| method | gradient steps | solved | success rate (95 % interval) |", "|---|---|---|---|"]
    for row in rows:
        rate = int(row["successes"]) / int(row["episodes"])
        interval = f"{rate:.2f} ({float(row['low']):.2f} to {float(row['high']):.2f})"
        lines.append(f"| {row['method']} | {row['steps']} | {row['successes']} of {row['episodes']} | {interval} |")
    return "\n".join(lines)


def write_demo_report(output: Path, settings: DemoSettings, rows: list[dict[str, Any]], seconds: float) -> str:
    """
    :param output: folder of the demo
    :param settings: the settings
    :param rows: rows of the table
    :param seconds: duration of the demo
    :return: the text of ``report.md``
    """
    machine = f"{settings.n_workers} processes, PyTorch {th.__version__}, Python {platform.python_version()}"
    report = f"""# {settings.task} from {settings.n_examples} examples of success

{result_table(rows)}

An episode succeeds if it solves the task after any decision. Each run has seed {settings.seed} and counts by its last policy;
no checkpoint was selected. The data: {BEHAVIOUR}; {settings.episodes_per_task} episodes of each of five tasks, without rewards
or task labels.

![The policy](policy.gif)

![Learning curves](learning_curve.png)

![The classifier along a successful and a failed trajectory](classifier.png)

Took {seconds / 60:.1f} minutes ({machine}; sb3-offline {sb3_offline.__version__}).
Settings: `{json.dumps(asdict(settings))}`
"""
    with replacing(output / "report.md") as temporary:
        temporary.write_text(report, encoding="utf-8")
    return report
