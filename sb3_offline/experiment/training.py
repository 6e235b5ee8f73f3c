"""Train one model: a config, a dataset and examples become a saved model and a table of evaluations."""

import importlib
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import yaml
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import LinearSchedule

import sb3_offline
from sb3_offline.common.example_based import ExampleBasedAlgorithm
from sb3_offline.common.offline_algorithm import OfflineAlgorithm
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.files import replacing
from sb3_offline.data.pickles import check_model
from sb3_offline.envs import lacks_task
from sb3_offline.experiment.data import DATA_ENTRIES, data_arguments
from sb3_offline.experiment.evaluation import make_evaluation_env
from sb3_offline.experiment.evaluation_table import EvaluationTable
from sb3_offline.experiment.run import CONFIG_FILE, MODEL_FILE, PENDING_FILE, RESUME_FILE, TrainingRun, locked_run, read_record

# Beginning of the names of an earlier run's tables, while a new run replaces it.
EARLIER = "earlier_"


class _ReplaceEarlierRun(BaseCallback):
    """
    Takes over a folder once the data turned out to be good. The model of an earlier run and its ``config.yml`` stay until the
    new model is whole, and its tables stay under other names. A file says that the folder is taken over, so that the new run
    counts as finished only when its own model and tables are there.
    """

    def __init__(self, output: Path, record: dict[str, Any]):
        super().__init__()
        self.output, self.record = output, record

    def _on_training_start(self) -> None:
        pending = self.output / PENDING_FILE
        is_earlier = (self.output / MODEL_FILE).is_file()
        for table in self.output.glob("evaluations*.csv"):
            if is_earlier and not pending.is_file():
                table.replace(table.with_name(EARLIER + table.name))
            else:
                table.unlink(missing_ok=True)
        (self.output / RESUME_FILE).unlink(missing_ok=True)
        _write_record(pending if is_earlier else self.output / CONFIG_FILE, self.record)
        if not is_earlier:
            pending.unlink(missing_ok=True)

    def _on_step(self) -> bool:
        return True


def _write_record(path: Path, record: dict[str, Any]) -> None:
    with replacing(path) as temporary:
        temporary.write_text(yaml.safe_dump(record, sort_keys=False), encoding="utf-8")


def _finish(model: BaseAlgorithm, output: Path, record: dict[str, Any]) -> None:
    """Save the trained model. It replaces that of an earlier run, if there is one, and then the files of that run go."""
    save_whole(model, output / MODEL_FILE)
    pending = output / PENDING_FILE
    if pending.is_file():  # until it is gone, the run does not count as finished
        _write_record(output / CONFIG_FILE, record)
        for table in output.glob(f"{EARLIER}evaluations*.csv"):
            table.unlink(missing_ok=True)
        pending.unlink()
    (output / RESUME_FILE).unlink(missing_ok=True)


class _SaveForResume(BaseCallback):
    """Saves everything that a killed run needs to continue. It runs last, after the other callbacks wrote their files."""

    def __init__(self, path: Path, save_freq: int):
        super().__init__()
        self.path, self.save_freq = path, save_freq

    def _on_step(self) -> bool:
        if self.num_timesteps % self.save_freq == 0 and self.num_timesteps < self.model._total_timesteps:
            save_whole(self.model, self.path)
        return True


def save_whole(model: BaseAlgorithm, path: Path) -> None:
    """
    Save a model such that a kill never leaves half a file.

    :param model: the model
    :param path: the zip file
    """
    with replacing(path) as temporary:
        model.save(temporary)


def find_algorithm(name: str) -> type[OfflineAlgorithm]:
    """
    :param name: name in :data:`sb3_offline.ALGOS`
    :return: the class; raises ``RuntimeError`` if there is none of that name
    """
    if name not in sb3_offline.ALGOS:
        raise RuntimeError(f"There is no algorithm {name!r}; choose one of {', '.join(sb3_offline.ALGOS)}")
    return sb3_offline.ALGOS[name]


def learns_from_examples(name: str) -> bool:
    """
    :param name: name in :data:`sb3_offline.ALGOS`
    :return: True if the algorithm's constructor takes success examples
    """
    return issubclass(find_algorithm(name), ExampleBasedAlgorithm)


def create_model(
    algo: str,
    config: dict[str, Any],
    dataset: Any = None,
    examples: Any = None,
    seed: int = 0,
    **kwargs: Any,
) -> OfflineAlgorithm:
    """
    Create an untrained model from a config.

    :param algo: name in :data:`sb3_offline.ALGOS`
    :param config: hyperparameters, as :func:`~sb3_offline.experiment.config.load_config` returns them
    :param dataset: dataset path(s) (default: those of the config)
    :param examples: success examples, for the algorithms that learn from them (default: those of the config)
    :param seed: seed of the run
    :param kwargs: further constructor arguments
    :return: the model; raises ``RuntimeError`` if the constructor refuses its arguments
    """
    arguments = {key: value for key, value in config.items() if key not in ("n_timesteps", "env_kwargs", *DATA_ENTRIES)}
    data = data_arguments(config, dataset, examples, takes_examples=learns_from_examples(algo))
    arguments = {**arguments, "env": None, **data, "seed": seed, **kwargs}
    if "frame_stack" in arguments:  # the RL Zoo's name
        arguments["n_stack"] = arguments.pop("frame_stack")
    if isinstance(arguments.get("learning_rate"), str):
        arguments["learning_rate"] = _schedule(arguments["learning_rate"])
    try:
        return find_algorithm(algo)(**arguments)
    except (TypeError, AssertionError) as error:  # SB3 asserts that a policy fits its spaces
        raise RuntimeError(f"{algo}: {error}; check the config, --hyperparams, --dataset and --examples") from error


def _schedule(text: str) -> LinearSchedule:
    """:return: the meaning of "lin_3e-4" in the RL Zoo: a rate that falls linearly to 0"""
    kind, _, number = text.partition("_")
    try:
        value = float(number)
    except ValueError:
        value, kind = 0.0, ""
    if kind != "lin":
        raise RuntimeError(f"learning_rate is {text!r}; give a number, or lin_NUMBER for one that falls to 0")
    return LinearSchedule(value, 0.0, 1.0)


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
    Train one model, and leave ``model.zip``, ``config.yml`` and, with ``eval_freq``, ``evaluations.csv`` in a folder.

    :param algo: name in :data:`sb3_offline.ALGOS`
    :param env_id: environment to evaluate in
    :param config: hyperparameters, as :func:`~sb3_offline.experiment.config.load_config` returns them
    :param output: folder, which is created
    :param dataset: dataset path(s) (default: those of the config)
    :param examples: success examples, for the algorithms that learn from them (default: those of the config)
    :param env_kwargs: keyword arguments of the environment, in addition to those of the config
    :param seed: seed of the run
    :param eval_freq: gradient steps between evaluations (0 or less: no evaluations)
    :param n_eval_episodes: number of episodes in each evaluation
    :param save_freq: gradient steps between two saves of everything that the run needs to continue (0: no saves). A killed run
        that is started again with the same arguments continues from its last save, and ends as if it had never stopped.
    :param progress_bar: show a progress bar
    :param callbacks: more callbacks; an :class:`~sb3_offline.experiment.evaluation_table.EvaluationTable` among them continues
        with the run
    :param verbose: 1 for info messages
    :return: the trained model
    """
    described = TrainingRun(
        algo,
        env_id,
        config,
        output,
        dataset=dataset,
        examples=examples,
        env_kwargs=env_kwargs or {},
        seed=seed,
        eval_freq=eval_freq,
        n_eval_episodes=n_eval_episodes,
        save_freq=save_freq,
    )
    return train_run(described, progress_bar=progress_bar, callbacks=callbacks, verbose=verbose)


def train_run(
    run: TrainingRun, *, progress_bar: bool = True, callbacks: Sequence[BaseCallback] = (), verbose: int = 0
) -> OfflineAlgorithm:
    """
    Do what :func:`train` does, for a run that is given as a value.

    :param run: the run
    :param progress_bar: show a progress bar
    :param callbacks: more callbacks; an :class:`~sb3_offline.experiment.evaluation_table.EvaluationTable` among them continues
        with the run
    :param verbose: 1 for info messages
    :return: the trained model
    :raises RunInUseError: if another process trains in the folder
    """
    with locked_run(run.output):
        return _train_run(run, progress_bar, callbacks, verbose)


def _train_run(run: TrainingRun, progress_bar: bool, callbacks: Sequence[BaseCallback], verbose: int) -> OfflineAlgorithm:
    record = run.record()
    config = {**run.config, "env_kwargs": record["env_kwargs"]}
    _check_counts({"n_timesteps": config["n_timesteps"], "n_eval_episodes": run.n_eval_episodes})
    all_callbacks = list(callbacks)
    if run.eval_freq > 0:
        _check_registered(run.env_id)
        if lacks_task(run.env_id, config["env_kwargs"]):
            raise RuntimeError(f"{run.env_id} has several tasks; say which one to evaluate: --task, or `task` in env_kwargs")
        all_callbacks.append(
            EvaluationTable(
                run.output / "evaluations.csv",
                run.env_id,
                config["env_kwargs"],
                run.eval_freq,
                run.n_eval_episodes,
                verbose=verbose,
            )
        )
    tables = [callback for callback in all_callbacks if isinstance(callback, EvaluationTable)]
    model = _saved_model(run, config, tables)
    if model is None:
        model = create_model(run.algo, config, run.dataset, run.examples, run.seed, verbose=verbose)
        if run.eval_freq > 0:
            _check_playable(model, run.env_id, config["env_kwargs"])
        all_callbacks.insert(0, _ReplaceEarlierRun(run.output, record))
    all_callbacks += model.default_callbacks()
    if run.save_freq:
        all_callbacks.append(_SaveForResume(run.output / RESUME_FILE, run.save_freq))
    n_timesteps = config["n_timesteps"] - model.num_timesteps
    is_new = model.num_timesteps == 0
    model.learn(n_timesteps, callback=all_callbacks, reset_num_timesteps=is_new, progress_bar=progress_bar)
    _finish(model, run.output, record)
    return model


def _saved_model(run: TrainingRun, config: dict[str, Any], tables: list[EvaluationTable]) -> OfflineAlgorithm | None:
    """:return: the last save of the same run, unless that run made other evaluations than the tables ask for"""
    file = run.output / RESUME_FILE
    if not (run.save_freq and file.is_file() and run.is_recorded()):
        return None
    arguments = data_arguments(config, run.dataset, run.examples, takes_examples=learns_from_examples(run.algo))
    try:
        model = find_algorithm(run.algo).load(file, **arguments)
    except DatasetError:  # the data, not the save
        raise
    except Exception as error:  # a damaged zip raises errors of any type
        warnings.warn(f"{file}: is damaged ({' '.join(str(error).split())[:200]}), so the run starts from the beginning.")
        return None
    return model if all(table.is_complete(model.num_timesteps) for table in tables) else None


def _check_counts(counts: dict[str, Any]) -> None:
    for name, count in counts.items():
        if not isinstance(count, int | float) or count < 1:
            raise RuntimeError(f"{name} is {count!r}; give a number of at least 1")


def _check_registered(env_id: str) -> None:
    """:param env_id: environment to evaluate in; "module:id" imports the module first, as in ``gym.make``"""
    module, _, name = env_id.rpartition(":")
    try:
        if module:
            importlib.import_module(module)
        gym.spec(name)
    except (gym.error.Error, ImportError) as error:
        raise RuntimeError(f"There is no environment {env_id!r} to evaluate in: {error}") from error


def _check_playable(model: OfflineAlgorithm, env_id: str, env_kwargs: dict[str, Any]) -> None:
    """Raise an error before the model learns if it cannot play in the environment to evaluate it in."""
    try:
        env = make_evaluation_env(env_id, env_kwargs, seed=0, n_stack=model.n_stack)
        try:
            env.step(model.predict(env.reset(), deterministic=True)[0])  # type: ignore[arg-type]
        finally:
            env.close()
    except (TypeError, ValueError) as error:
        remedy = "evaluate in the environment that the data come from: --env, --task and env_kwargs"
        raise RuntimeError(f"{env_id} and the data do not fit: {error}; {remedy}") from error


def load_run(model_path: Path, *, trust: bool = False) -> tuple[OfflineAlgorithm, dict[str, Any]]:
    """
    :param model_path: ``model.zip`` that :func:`train` left, with its ``config.yml`` beside it
    :param trust: open the file even if it may run any code. Without it, the pickles in it may hold only values of known
        libraries, as those of a model with the classes of this package do
    :return: the model and the record of its run
    :raises DatasetError: if the model may run other code
    """
    config_file = model_path.with_name(CONFIG_FILE)
    for file in (model_path, config_file):
        if not file.is_file():
            raise RuntimeError(f"{file}: there is no such file; give the model.zip in the folder of a training run")
    config = read_record(config_file)
    if not trust:
        check_model(model_path, "If you trust its origin, say so: --trust, or load_run(path, trust=True)")
    return find_algorithm(config["algo"]).load(model_path), config
