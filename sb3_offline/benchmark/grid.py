"""A grid: the methods, tasks and seeds of a table and its protocol, read from one YAML file."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import Any, TypeAlias

from sb3_offline.experiment.config import load_config, read_yaml
from sb3_offline.experiment.data import uses_labels
from sb3_offline.experiment.evaluation import EVALUATION_SEED
from sb3_offline.experiment.evaluation_table import EvaluationTable
from sb3_offline.experiment.run import TrainingRun
from sb3_offline.experiment.training import learns_from_examples

#: Method, task and seed.
Cell: TypeAlias = tuple[str, str, int]


@dataclass(frozen=True)
class Method:
    """
    One row of the table.

    :param algo: name in :data:`sb3_offline.ALGOS`
    :param config: name of a shipped config, or a YAML file
    :param changes: entries that replace those of the config; dicts are merged
    """

    algo: str
    config: str
    changes: dict[str, Any] = field(default_factory=dict)

    def __str__(self) -> str:
        return " ".join([self.config, *(f"{key}={value}" for key, value in self.changes.items())])


@dataclass(frozen=True)
class Grid:
    """
    A table of methods, tasks and seeds, with a protocol that is fixed before any run. A cell counts by its last
    ``checkpoints`` checkpoints, evenly spaced over the last half of its gradient steps (five of them: at 60, 70, 80, 90 and
    100 %). Each plays ``episodes`` episodes. The episodes differ between checkpoints and between seeds, and are the same for
    all cells of a seed. No checkpoint is selected.

    :param env: id of the environment
    :param methods: methods by the name of their row
    :param tasks: values of the environment's keyword argument ``task``
    :param seeds: seeds of the runs
    :param n_timesteps: number of gradient steps, the same for every method
    :param dataset: path, pattern, or a list of these; ``{task}`` in a text stands for the task
    :param examples: path of the success examples, for the methods that learn from them; ``{task}`` stands for the task
    :param env_kwargs: keyword arguments of the environment, in addition to those of the configs
    :param save_freq: gradient steps between two saves, from which a killed run continues
    :param checkpoints: number of checkpoints that count
    :param episodes: number of episodes that each checkpoint plays
    """

    env: str
    methods: dict[str, Method]
    tasks: list[str]
    seeds: list[int]
    n_timesteps: int
    dataset: str | list[str]
    examples: str | None = None
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    save_freq: int = 500
    checkpoints: int = 5
    episodes: int = 10

    def __post_init__(self) -> None:
        for kind, names in {"methods": self.methods, "tasks": self.tasks}.items():
            for name in names:
                if not name.strip(". ") or not name.isprintable() or set(name) & set('/\\:*?"<>|'):
                    raise RuntimeError(f"{kind}: {name!r} names files, so it must be a word without slashes; rename it")
        if self.n_timesteps % (2 * self.checkpoints) or self.n_timesteps <= 0:
            raise RuntimeError(
                f"n_timesteps is {self.n_timesteps}, but {self.checkpoints} checkpoints evenly spaced over the last half "
                f"need a multiple of {2 * self.checkpoints}"
            )

    def cells(
        self, methods: Iterable[str] | None = None, tasks: Iterable[str] | None = None, seeds: Iterable[int] | None = None
    ) -> list[Cell]:
        """
        :param methods: methods to keep (default: all)
        :param tasks: tasks to keep (default: all)
        :param seeds: seeds to keep (default: all)
        :return: method, task and seed of each cell. The seeds are outermost, so that a grid that stops early is a complete
            grid of fewer seeds.
        """
        chosen: dict[str, list[Any]] = {}
        for name, wanted in {"methods": methods, "tasks": tasks, "seeds": seeds}.items():
            own = list(getattr(self, name))
            chosen[name] = own if wanted is None else list(wanted)
            unknown = [part for part in chosen[name] if part not in own]
            if unknown:
                raise RuntimeError(f"The grid's {name} are {', '.join(map(str, own))}; it has no {unknown[0]}")
        return [(name, task, seed) for seed in chosen["seeds"] for task in chosen["tasks"] for name in chosen["methods"]]

    def evaluation_steps(self) -> list[int]:
        """:return: gradient steps of the checkpoints that count"""
        spacing = self.n_timesteps // (2 * self.checkpoints)
        return [spacing * (self.checkpoints + 1 + index) for index in range(self.checkpoints)]


@dataclass(frozen=True)
class GridRun:
    """
    One training run of a grid. It fills one cell of the table, or the cells of all tasks if nothing that it learns from
    depends on the task: then the policy is trained once and evaluated on every task, with the same protocol and the same
    outcome as if it had been trained once for each.

    :param label: method, tasks and seed in words
    :param tasks: the tasks that the policy is evaluated on
    :param training: what is trained
    :param grid: the parent grid
    """

    label: str
    tasks: tuple[str, ...]
    training: TrainingRun
    grid: Grid

    @property
    def folder(self) -> Path:
        """Folder of the run's files."""
        return self.training.output

    def tables(self) -> list[EvaluationTable]:
        """:return: for each task, the callback that evaluates the policy"""
        return [self.table(task) for task in self.tasks]

    def table(self, task: str) -> EvaluationTable:
        """
        :param task: one of the run's tasks
        :return: the callback that evaluates the policy on this task
        """
        grid, config = self.grid, self.training.config
        n_early, seed = grid.checkpoints, self.training.seed  # evaluations in the first half are for the learning curve
        return EvaluationTable(
            self.folder / f"evaluations-{task}.csv",
            grid.env,
            {**config.get("env_kwargs", {}), "task": task},
            eval_freq=grid.n_timesteps // (2 * grid.checkpoints),
            n_episodes=grid.episodes,
            count_from=grid.evaluation_steps()[0],
            seeds=[evaluation_seed(seed, (n_early + index) % (2 * n_early)) for index in range(2 * n_early)],
        )

    def is_finished(self) -> bool:
        """:return: True if the policy is trained and fully evaluated"""
        whole = all(table.is_complete(self.grid.n_timesteps) for table in self.tables())
        return whole and self.training.is_finished()


def load_grid(name: str) -> Grid:
    """
    :param name: a YAML file, or the name of a shipped grid (``"table1_states"``)
    :return: the grid; raises ``RuntimeError`` if an entry is missing or wrong
    """
    path, content = read_yaml(name, "grid", "grids/")
    content = _checked(content, Grid, f"{path}")
    for key, kind in (("methods", Mapping), ("env_kwargs", Mapping), ("tasks", list), ("seeds", list)):
        if key in content and not (isinstance(content[key], kind) and (content[key] or key == "env_kwargs")):
            raise RuntimeError(f"{path}: {key}: is {content[key]!r}; give a {'list' if kind is list else 'section'}")
    parts = {"tasks": (str, "names (quoted, if they look like numbers)"), "seeds": (int, "whole numbers")}
    for key, (part_kind, what) in parts.items():
        if not all(isinstance(part, part_kind) for part in content[key]):
            raise RuntimeError(f"{path}: {key}: is {content[key]!r}; give a list of {what}")
    if not isinstance(content["env"], str):
        raise RuntimeError(f"{path}: env: is {content['env']!r}; give the id of an environment")
    _check_paths(content, f"{path}")
    for key in ("n_timesteps", "save_freq", "checkpoints", "episodes"):
        if key in content and (not isinstance(content[key], int) or content[key] < 1):
            raise RuntimeError(f"{path}: {key}: is {content[key]!r}; give a whole number of at least 1")
    methods = {
        name: Method(**_checked(section, Method, f"{path}: methods: {name}")) for name, section in content["methods"].items()
    }
    for name, method in methods.items():
        if not (isinstance(method.algo, str) and isinstance(method.config, str) and isinstance(method.changes, Mapping)):
            raise RuntimeError(f"{path}: methods: {name}: give texts for algo and config, and a section for changes")
        _check_paths(method.changes, f"{path}: methods: {name}: changes")
    try:
        return Grid(**{**content, "methods": methods})
    except RuntimeError as error:
        raise RuntimeError(f"{path}: {error}") from error


def _check_paths(section: Mapping[str, Any], place: str) -> None:
    dataset, examples = section.get("dataset", ""), section.get("examples", "")
    if not isinstance(dataset, str) and not (isinstance(dataset, list) and all(isinstance(part, str) for part in dataset)):
        raise RuntimeError(f"{place}: dataset: is {dataset!r}; give a path, a pattern, or a list of these")
    if not isinstance(examples, str | None):
        raise RuntimeError(f"{place}: examples: is {examples!r}; give a path")


def _checked(section: Any, kind: type, place: str) -> dict[str, Any]:
    """:return: the section, if its keys are those of the dataclass"""
    known = {part.name: part.default is MISSING and part.default_factory is MISSING for part in fields(kind)}
    if not isinstance(section, Mapping):
        raise RuntimeError(f"{place}: is {section!r}; write a section with {', '.join(known)}")
    for wrong, what in ((set(section) - set(known), "unknown"), ({k for k in known if known[k]} - set(section), "missing")):
        if wrong:
            raise RuntimeError(f"{place}: {', '.join(sorted(map(str, wrong)))}: {what}; the keys are {', '.join(known)}")
    return dict(section)


def plan(grid: Grid, runs: Path, chosen: Sequence[Cell] | None = None) -> dict[Cell, GridRun]:
    """
    Find the runs that fill the cells of a grid.

    :param grid: the grid
    :param runs: folder of all runs
    :param chosen: some of :meth:`Grid.cells` (default: all)
    :return: the run of each chosen cell. A run for all tasks is evaluated on all tasks of the grid, whichever are chosen.
    """
    folders = [_folder_name(name) for name in grid.methods]
    if len({*folders}) < len(folders):
        raise RuntimeError(f"Two of the methods would share a folder of {', '.join(sorted(folders))}; rename one")
    chosen = grid.cells() if chosen is None else chosen
    methods = {name: grid.methods[name] for name, _, _ in chosen}  # the configs of other methods may be missing
    configs = {name: merged(load_config(method.config, grid.env), method.changes) for name, method in methods.items()}
    of_all_tasks: dict[tuple[str, int], GridRun] = {}
    cells: dict[Cell, GridRun] = {}
    for name, task, seed in chosen:
        if _depends_on_task(grid, methods[name], configs[name]):
            cells[name, task, seed] = _run(grid, name, configs[name], seed, task, [task], runs)
        else:
            if (name, seed) not in of_all_tasks:
                of_all_tasks[name, seed] = _run(grid, name, configs[name], seed, None, grid.tasks, runs)
            cells[name, task, seed] = of_all_tasks[name, seed]
    return cells


def _run(
    grid: Grid, name: str, config: dict[str, Any], seed: int, task: str | None, tasks: Sequence[str], runs: Path
) -> GridRun:
    """
    :param name: name of the method
    :param config: config of the method
    :param task: the task to train for; ``None`` for a run of all tasks
    :param tasks: the tasks to evaluate on
    """
    method = grid.methods[name]
    dataset, examples = _data(grid, method, config)
    if _takes_examples(method, config) and examples is None and "labels" not in config:
        raise RuntimeError(f"{name} learns from success examples; say where they are: `examples:`")
    env_kwargs = {**config.get("env_kwargs", {}), **grid.env_kwargs}
    training = TrainingRun(
        method.algo,
        grid.env,
        {**config, "env_kwargs": env_kwargs, "n_timesteps": grid.n_timesteps},
        _run_folder(runs, name, seed, task),
        dataset=_filled(dataset, tasks[0]),
        examples=_filled(examples, tasks[0]),
        env_kwargs={"task": task} if task else {},
        seed=seed,
        save_freq=grid.save_freq,
    )
    return GridRun(f"{name} {', '.join(tasks)} seed {seed}", tuple(tasks), training, grid)


def _takes_examples(method: Method, config: dict[str, Any]) -> bool:
    """:return: True if the algorithm learns from success examples, or its episodes or rewards are found by these"""
    return learns_from_examples(method.algo) or uses_labels(config)


def _depends_on_task(grid: Grid, method: Method, config: dict[str, Any]) -> bool:
    """:return: True if the examples, the files or the episodes that a method learns from differ between tasks"""
    texts = (*_data(grid, method, config), config.get("episodes"), config.get("labels"))
    return any("{task}" in str(text) for text in texts)


def _data(grid: Grid, method: Method, config: dict[str, Any]) -> tuple[Any, Any]:
    """:return: paths of a method's dataset and examples: those of its changes, or else of the grid"""
    dataset, examples = (method.changes.get(name, getattr(grid, name)) for name in ("dataset", "examples"))
    return dataset, examples if _takes_examples(method, config) else None


def _filled(paths: Any, task: str) -> Any:
    """:return: the path or the paths for a task"""
    return [_filled(path, task) for path in paths] if isinstance(paths, list) else paths and paths.replace("{task}", task)


def evaluation_seed(seed: int, checkpoint: int) -> int:
    """
    :param seed: seed of a run
    :param checkpoint: index of the checkpoint; 0 is the first one that counts
    :return: seed of the episodes of that evaluation
    """
    return EVALUATION_SEED + 1000 * (1 + seed) + checkpoint


def cell_folder(runs: Path, method: str, task: str, seed: int) -> Path:
    """
    :param runs: folder of all runs
    :param method: method of the cell
    :param task: task of the cell
    :param seed: seed of the cell
    :return: folder of the run that fills the cell
    """
    own = _run_folder(runs, method, seed, task)
    return own if own.is_dir() else _run_folder(runs, method, seed, None)


def _run_folder(runs: Path, method: str, seed: int, task: str | None) -> Path:
    return runs / _folder_name(method) / (f"seed{seed}" if task is None else f"{task}-seed{seed}")


def _folder_name(name: str) -> str:
    """:return: the name of a row without characters that folders should not have"""
    return "".join(letter if letter.isalnum() or letter in "._" else "-" for letter in name)


def merged(config: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """
    :param config: config of an algorithm
    :param changes: new values
    :return: the config with the new values; dicts are merged
    """
    return {
        **config,
        **{key: merged(config.get(key, {}), new) if isinstance(new, dict) else new for key, new in changes.items()},
    }
