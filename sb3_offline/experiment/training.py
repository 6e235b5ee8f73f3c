"""One training run: a config, a dataset and examples become checkpoints and a table of evaluations."""

import csv
import importlib
import json
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import yaml
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import LinearSchedule

import sb3_offline
from sb3_offline.common.callbacks import log_at_once
from sb3_offline.common.offline_algorithm import OfflineAlgorithm
from sb3_offline.data.files import replacing
from sb3_offline.data.reader import OfflineDataset
from sb3_offline.envs import lacks_task
from sb3_offline.experiment.data import resolve_data
from sb3_offline.experiment.evaluation import EVALUATION_SEED, Evaluation, evaluate_success, make_evaluation_env

EVALUATION_FIELDS = ("step", "episodes", "successes", "mean_return")
RESUME_FILE = "resume.zip"


class EvaluationTable(BaseCallback):
    """
    Evaluates at regular steps and keeps a CSV file with a row for each. Where a saved model goes on learning, rows up to its
    step stay, so that the model and the table never disagree.

    :param path: of the CSV file
    :param env_id: registered id
    :param env_kwargs: of the environment
    :param eval_freq: gradient steps between evaluations
    :param n_episodes: episodes of each
    :param count_from: evaluations at earlier steps may be missing where the table is complete
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
        count_from: int = 0,
        seeds: Sequence[int] | None = None,
        verbose: int = 0,
    ):
        super().__init__(verbose)
        self.path, self.env_id, self.env_kwargs = path, env_id, env_kwargs
        self.eval_freq, self.n_episodes, self.count_from, self.seeds = eval_freq, n_episodes, count_from, seeds

    def rows(self, until: int) -> list[dict[str, str]]:
        """
        :param until: last step to look at
        :return: what the file holds up to there, by :data:`EVALUATION_FIELDS`
        """
        if not self.path.is_file():
            return []
        with self.path.open(newline="") as file:
            return [row for row in csv.DictReader(file) if int(row["step"]) <= until]

    def steps(self, until: int) -> list[int]:
        """
        :param until: last step to look at
        :return: steps up to there at which there have to be evaluations
        """
        return [step for step in range(self.eval_freq, until + 1, self.eval_freq) if step >= self.count_from]

    def counted_rows(self, until: int) -> list[dict[str, str]]:
        """
        :param until: last step to look at
        :return: those of :meth:`rows` that count
        """
        return [row for row in self.rows(until) if int(row["step"]) >= self.count_from]

    def is_complete(self, until: int) -> bool:
        """
        :param until: last step to look at
        :return: whether the file holds all evaluations that count up to there
        """
        found = [(int(row["step"]), int(row["episodes"])) for row in self.counted_rows(until)]
        return found == [(step, self.n_episodes) for step in self.steps(until)]

    def _on_training_start(self) -> None:
        self._write(self.rows(self.num_timesteps))

    def _on_step(self) -> bool:
        if self.num_timesteps % self.eval_freq == 0:
            rows = self.rows(self.num_timesteps - 1)
            seed = EVALUATION_SEED if self.seeds is None else self.seeds[self.num_timesteps // self.eval_freq - 1]
            result = evaluate_success(self.model, self.env_id, self.env_kwargs, self.n_episodes, seed)
            values = map(str, evaluation_row(self.num_timesteps, result))
            self._write([*rows, dict(zip(EVALUATION_FIELDS, values, strict=True))])
            log_at_once(self, {"eval/success_rate": result.success_rate})
            if self.verbose:
                print(f"step {self.num_timesteps}: {sum(result.successes)} of {self.n_episodes} episodes solved")
        return True

    def _write(self, rows: list[dict[str, str]]) -> None:
        with replacing(self.path) as temporary, temporary.open("w", newline="") as file:
            writer = csv.DictWriter(file, EVALUATION_FIELDS)
            writer.writeheader()
            writer.writerows(rows)


class _ReplaceEarlierRun(BaseCallback):
    """
    Takes over a folder when the data were found good. Files of an earlier run go first: this one is finished when its own
    model and tables are there.
    """

    def __init__(self, output: Path, record: dict[str, Any]):
        super().__init__()
        self.output, self.record = output, record

    def _on_training_start(self) -> None:
        for stale in (self.output / "model.zip", self.output / RESUME_FILE, *self.output.glob("evaluations*.csv")):
            stale.unlink(missing_ok=True)
        with replacing(self.output / "config.yml") as temporary:
            temporary.write_text(yaml.safe_dump(self.record, sort_keys=False))

    def _on_step(self) -> bool:
        return True


class _SaveForResume(BaseCallback):
    """Saves all that a killed run needs to go on. The last callback: what others wrote at this step is on the disk before."""

    def __init__(self, path: Path, save_freq: int):
        super().__init__()
        self.path, self.save_freq = path, save_freq

    def _on_step(self) -> bool:
        if self.num_timesteps % self.save_freq == 0 and self.num_timesteps < self.model._total_timesteps:
            save_whole(self.model, self.path)
        return True


def save_whole(model: BaseAlgorithm, path: Path) -> None:
    """
    :param model: is saved, so that no kill leaves half a file
    :param path: of the zip file
    """
    with replacing(path) as temporary:
        model.save(temporary)


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
    arguments = {key: value for key, value in config.items() if key not in ("n_timesteps", "env_kwargs", "episodes")}
    arguments = {**arguments, "env": None, **_data_arguments(config, dataset, examples), "seed": seed, **kwargs}
    if isinstance(arguments.get("learning_rate"), str):
        arguments["learning_rate"] = _schedule(arguments["learning_rate"])
    try:
        return find_algorithm(algo)(**arguments)
    except (TypeError, AssertionError) as error:  # SB3 asserts that a policy fits its spaces
        raise RuntimeError(f"{algo}: {error}; check the config, --hyperparams, --dataset and --examples") from error


def _schedule(text: str) -> LinearSchedule:
    """:return: what "lin_3e-4" means to the RL Zoo: a rate that falls to 0"""
    kind, _, number = text.partition("_")
    try:
        value = float(number)
    except ValueError:
        value, kind = 0.0, ""
    if kind != "lin":
        raise RuntimeError(f"learning_rate is {text!r}; give a number, or lin_NUMBER for one that falls to 0")
    return LinearSchedule(value, 0.0, 1.0)


def _data_arguments(config: dict[str, Any], dataset: Any, examples: Any) -> dict[str, Any]:
    """:return: arguments of a model's constructor, and of ``load``, that say what it learns from"""
    resolved = resolve_data({**config, **_given(dataset, examples)}, config.get("env_kwargs", {}))
    return {key: resolved[key] for key in ("dataset", "examples") if key in resolved}


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
    save_freq: int = 0,
    progress_bar: bool = True,
    callbacks: Sequence[BaseCallback] = (),
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
    :param eval_freq: gradient steps between evaluations (0 or less: none)
    :param n_eval_episodes: episodes of each evaluation
    :param save_freq: gradient steps between two saves of all that the run needs to go on (0: none). A run that was killed
        goes on from the last one when it is started again with the same arguments, and ends as if it had never stopped.
    :param progress_bar: whether to show one
    :param callbacks: more callbacks; an :class:`EvaluationTable` among them goes on with the run
    :param verbose: 1 for info messages
    :return: the trained model
    """
    record = run_record(algo, env_id, config, dataset=dataset, examples=examples, env_kwargs=env_kwargs, seed=seed)
    config = {**config, "env_kwargs": record["env_kwargs"]}
    all_callbacks = list(callbacks)
    counts = {"n_timesteps": config["n_timesteps"], "n_eval_episodes": n_eval_episodes}
    for name, count in counts.items():
        if not isinstance(count, int | float) or count < 1:
            raise RuntimeError(f"{name} is {count!r}; give a number of at least 1")
    if eval_freq > 0:
        _check_registered(env_id)
        if lacks_task(env_id, config["env_kwargs"]):
            raise RuntimeError(f"{env_id} has several tasks; say which one to evaluate: --task, or `task` in env_kwargs")
        table = output / "evaluations.csv"
        all_callbacks.append(EvaluationTable(table, env_id, config["env_kwargs"], eval_freq, n_eval_episodes, verbose=verbose))
    resume_file, model = output / RESUME_FILE, None
    if save_freq and resume_file.is_file() and recorded_run(output) == record:
        model = find_algorithm(algo).load(resume_file, **_data_arguments(config, dataset, examples))
        tables = [callback for callback in all_callbacks if isinstance(callback, EvaluationTable)]
        if not all(table.is_complete(model.num_timesteps) for table in tables):
            model = None  # other evaluations were asked for than that run made
    if model is None:
        model = create_model(algo, config, dataset, examples, seed, verbose=verbose)
        if eval_freq > 0:
            _check_playable(model, env_id, config["env_kwargs"])
        all_callbacks.insert(0, _ReplaceEarlierRun(output, record))
    all_callbacks += model.default_callbacks()
    if save_freq:
        all_callbacks.append(_SaveForResume(resume_file, save_freq))
    n_timesteps = config["n_timesteps"] - model.num_timesteps
    is_new = model.num_timesteps == 0
    model.learn(n_timesteps, callback=all_callbacks, reset_num_timesteps=is_new, progress_bar=progress_bar)
    save_whole(model, output / "model.zip")
    resume_file.unlink(missing_ok=True)
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
    return json.loads(json.dumps(record, default=_identity))


def _identity(value: Any) -> str:
    """:return: what tells a value apart from others, also in another process"""
    if isinstance(value, OfflineDataset):
        return f"{value.path}, {value.n_episodes} episodes, {zlib.crc32(value.actions.tobytes()):08x}"
    if isinstance(value, np.ndarray):
        return f"array {value.shape}, {value.dtype}, {zlib.crc32(value.tobytes()):08x}"
    return f"{value.__module__}.{value.__qualname__}" if callable(value) and hasattr(value, "__qualname__") else str(value)


def _check_registered(env_id: str) -> None:
    """:param env_id: of an environment to evaluate in; "module:id" imports the module first, as in ``gym.make``"""
    module, _, name = env_id.rpartition(":")
    try:
        if module:
            importlib.import_module(module)
        gym.spec(name)
    except (gym.error.Error, ImportError) as error:
        raise RuntimeError(f"There is no environment {env_id!r} to evaluate in: {error}") from error


def _check_playable(model: OfflineAlgorithm, env_id: str, env_kwargs: dict[str, Any]) -> None:
    """Raise where a model and the environment to evaluate it in do not fit, before the model learns anything."""
    try:
        env = make_evaluation_env(env_id, env_kwargs, seed=0)
        try:
            env.step(model.predict(env.reset(), deterministic=True)[0])  # type: ignore[arg-type]
        finally:
            env.close()
    except (TypeError, ValueError) as error:
        remedy = "evaluate where the data are from: --env, --task and env_kwargs"
        raise RuntimeError(f"{env_id} and what is learned from do not fit: {error}; {remedy}") from error


def is_finished(output: Path, arguments: dict[str, Any]) -> bool:
    """
    :param output: folder of a run
    :param arguments: of :func:`train`
    :return: whether a run with these arguments is complete there
    """
    return (output / "model.zip").is_file() and recorded_run(output) == run_record(**arguments)


def recorded_run(output: Path) -> dict[str, Any] | None:
    """
    :param output: folder of a run
    :return: what :func:`train` wrote into its ``config.yml``
    """
    config_file = output / "config.yml"
    return yaml.safe_load(config_file.read_text()) if config_file.is_file() else None


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
