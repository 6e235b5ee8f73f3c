"""One training run: a config, a dataset and examples become checkpoints and a table of evaluations."""

import csv
import itertools
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import gymnasium as gym
import yaml
from stable_baselines3.common.callbacks import BaseCallback

import sb3_offline
from sb3_offline.ceborl import CEBORL, DiagnosticsCallback
from sb3_offline.common.offline_algorithm import OfflineAlgorithm
from sb3_offline.experiment.data import resolve_data
from sb3_offline.experiment.evaluation import EVALUATION_SEED, Evaluation, evaluate_success

EVALUATION_FIELDS = ("step", "episodes", "successes", "mean_return")


class EvaluationTable(BaseCallback):
    """
    Evaluates at regular steps and appends a row to a CSV file each time.

    :param path: of the CSV file, written anew
    :param env_id: registered id
    :param env_kwargs: of the environment
    :param eval_freq: gradient steps between evaluations
    :param n_episodes: episodes of each
    :param eval_start: no evaluation at an earlier step
    :param seeds: of the evaluations, one after the other (default: all play the same episodes)
    :param verbose: 1 prints each success rate
    """

    def __init__(
        self,
        path: Path,
        env_id: str,
        env_kwargs: dict[str, Any],
        eval_freq: int,
        n_episodes: int,
        eval_start: int = 0,
        seeds: Iterable[int] | None = None,
        verbose: int = 0,
    ):
        super().__init__(verbose)
        self.path, self.env_id, self.env_kwargs = path, env_id, env_kwargs
        self.eval_freq, self.n_episodes, self.eval_start = eval_freq, n_episodes, eval_start
        self.seeds = iter(seeds or itertools.repeat(EVALUATION_SEED))

    def _on_training_start(self) -> None:
        with self.path.open("w", newline="") as file:
            csv.writer(file).writerow(EVALUATION_FIELDS)

    def _on_step(self) -> bool:
        if self.num_timesteps % self.eval_freq == 0 and self.num_timesteps >= self.eval_start:
            result = evaluate_success(self.model, self.env_id, self.env_kwargs, self.n_episodes, next(self.seeds))
            with self.path.open("a", newline="") as file:
                csv.writer(file).writerow(evaluation_row(self.num_timesteps, result))
            self.logger.record("eval/success_rate", result.success_rate)
            if self.verbose:
                print(f"step {self.num_timesteps}: {sum(result.successes)} of {self.n_episodes} episodes solved")
        return True


def evaluation_row(step: int, result: Evaluation) -> tuple[int, int, int, float]:
    """
    :param step: gradient steps so far
    :param result: of that checkpoint
    :return: values of :data:`EVALUATION_FIELDS`
    """
    mean_return = sum(result.returns) / len(result.returns)
    return step, len(result.successes), sum(result.successes), round(mean_return, 3)


def find_algorithm(name: str) -> type[OfflineAlgorithm]:
    """
    :param name: in :data:`sb3_offline.ALGOS`
    :return: the class
    """
    if name not in sb3_offline.ALGOS:
        raise RuntimeError(f"There is no algorithm {name!r}; choose one of {', '.join(sb3_offline.ALGOS)}")
    return sb3_offline.ALGOS[name]


def create_model(
    algo: str,
    config: dict[str, Any],
    dataset: Any = None,
    examples: Any = None,
    seed: int = 0,
    **kwargs: Any,
) -> OfflineAlgorithm:
    """
    :param algo: name in :data:`sb3_offline.ALGOS`
    :param config: as :func:`~sb3_offline.experiment.config.load_config` returns it
    :param dataset: dataset path(s) (default: the config's)
    :param examples: success examples, for the algorithms that learn from them (default: the config's)
    :param seed: of the run
    :param kwargs: further constructor arguments
    :return: a model, not trained
    """
    arguments = resolve_data({**config, **_given(dataset, examples)}, config.get("env_kwargs", {}))
    arguments = {key: value for key, value in arguments.items() if key not in ("n_timesteps", "env_kwargs")}
    arguments.update(seed=seed, **kwargs)
    try:
        return find_algorithm(algo)(env=None, **arguments)  # type: ignore[arg-type]
    except TypeError as error:
        raise RuntimeError(f"{algo}: {error}; check the config, --hyperparams, --dataset and --examples") from error


def _given(dataset: Any, examples: Any) -> dict[str, Any]:
    return {key: value for key, value in (("dataset", dataset), ("examples", examples)) if value is not None}


def train(
    algo: str,
    env_id: str,
    config: dict[str, Any],
    output: Path,
    *,
    dataset: Any = None,
    examples: Any = None,
    env_kwargs: dict[str, Any] | None = None,
    seed: int = 0,
    eval_freq: int = 0,
    n_eval_episodes: int = 20,
    eval_start: int = 0,
    eval_seeds: Iterable[int] | None = None,
    progress_bar: bool = True,
    callback: BaseCallback | None = None,
    verbose: int = 0,
) -> OfflineAlgorithm:
    """
    Train one model and leave ``model.zip``, ``config.yml`` and, with ``eval_freq``, ``evaluations.csv`` in a folder.

    :param algo: name in :data:`sb3_offline.ALGOS`
    :param env_id: environment to evaluate in
    :param config: as :func:`~sb3_offline.experiment.config.load_config` returns it
    :param output: folder, created
    :param dataset: dataset path(s) (default: the config's)
    :param examples: success examples, for the algorithms that learn from them (default: the config's)
    :param env_kwargs: added to the config's
    :param seed: of the run
    :param eval_freq: gradient steps between evaluations (0: none)
    :param n_eval_episodes: episodes of each evaluation
    :param eval_start: no evaluation at an earlier step
    :param eval_seeds: of the evaluations' episodes, one after the other (default: all play the same episodes)
    :param progress_bar: whether to show one
    :param callback: one more callback
    :param verbose: 1 for info messages
    :return: the trained model
    """
    record = run_record(algo, env_id, config, dataset=dataset, examples=examples, env_kwargs=env_kwargs, seed=seed)
    if eval_freq:
        try:
            gym.spec(env_id)
        except gym.error.Error as error:
            raise RuntimeError(f"There is no environment {env_id!r} to evaluate in: {error}") from error
    output.mkdir(parents=True, exist_ok=True)
    all_env_kwargs = record["env_kwargs"]
    model = create_model(algo, {**config, "env_kwargs": all_env_kwargs}, dataset, examples, seed, verbose=verbose)
    (output / "model.zip").unlink(missing_ok=True)  # of an earlier run: this one is finished when its own is there
    (output / "config.yml").write_text(yaml.safe_dump(record, sort_keys=False))
    callbacks = [callback] if callback is not None else []
    if isinstance(model, CEBORL):
        callbacks.append(DiagnosticsCallback())
    if eval_freq:
        table = output / "evaluations.csv"
        callbacks.append(
            EvaluationTable(table, env_id, all_env_kwargs, eval_freq, n_eval_episodes, eval_start, eval_seeds, verbose)
        )
    model.learn(config["n_timesteps"], callback=callbacks, progress_bar=progress_bar)
    model.save(output / "model.zip")
    return model


def run_record(
    algo: str,
    env_id: str,
    config: dict[str, Any],
    *,
    dataset: Any = None,
    examples: Any = None,
    env_kwargs: dict[str, Any] | None = None,
    seed: int = 0,
    **_: Any,
) -> dict[str, Any]:
    """:return: what :func:`train`, with these arguments, writes into ``config.yml``"""
    all_env_kwargs = {**config.get("env_kwargs", {}), **(env_kwargs or {})}
    record = {"algo": algo, "env": env_id, **config, "env_kwargs": all_env_kwargs, "seed": seed, **_given(dataset, examples)}
    # Through JSON: paths and NumPy numbers become what a YAML file can hold.
    return json.loads(json.dumps(record, default=str))


def is_finished(output: Path, arguments: dict[str, Any]) -> bool:
    """
    :param output: folder of a run
    :param arguments: of :func:`train`
    :return: whether a run with these arguments is complete there
    """
    config_file = output / "config.yml"
    if not (output / "model.zip").is_file() or not config_file.is_file():
        return False
    return yaml.safe_load(config_file.read_text()) == run_record(**arguments)


def load_run(model_path: Path) -> tuple[OfflineAlgorithm, dict[str, Any]]:
    """
    :param model_path: ``model.zip`` that :func:`train` left, its ``config.yml`` beside it
    :return: the model and its config
    """
    config_file = model_path.with_name("config.yml")
    for file in (model_path, config_file):
        if not file.is_file():
            raise RuntimeError(f"{file}: there is no such file; give the model.zip in the folder of a training run")
    config = yaml.safe_load(config_file.read_text())
    return find_algorithm(config["algo"]).load(model_path), config
