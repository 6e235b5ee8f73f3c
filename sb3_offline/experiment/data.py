"""The dataset and the success examples that a config names."""

from typing import Any

from sb3_offline.data.reader import open_datasets
from sb3_offline.data.selection import select_episodes
from sb3_offline.labelling.selection import given_labels, select_detected

#: Entries of a config that name data. What a model gets of them is in :func:`data_arguments`
DATA_ENTRIES = ("dataset", "examples", "episodes", "labels")


def given_data(dataset: Any, examples: Any) -> dict[str, Any]:
    """
    :param dataset: dataset path(s) that replace those of a config, or ``None``
    :param examples: success examples that replace those of a config, or ``None``
    :return: the entries of the config that are replaced
    """
    return {key: value for key, value in (("dataset", dataset), ("examples", examples)) if value is not None}


def uses_labels(config: dict[str, Any]) -> bool:
    """
    :param config: hyperparameters
    :return: True if detected episodes or steps are asked for, which are found by success examples, whatever the algorithm
    """
    return "detected" in (config.get("episodes") or {}) or config.get("reward_fn") == "detected"


def data_arguments(
    config: dict[str, Any], dataset: Any = None, examples: Any = None, *, takes_examples: bool = True
) -> dict[str, Any]:
    """
    :param config: hyperparameters
    :param dataset: dataset path(s) (default: those of the config)
    :param examples: success examples (default: those of the config)
    :param takes_examples: whether the algorithm itself learns from examples
    :return: the arguments ``dataset``, ``examples`` and ``reward_fn`` of a model's constructor, as far as they are known
    """
    resolved = resolve_data({**config, **given_data(dataset, examples)}, config.get("env_kwargs", {}), takes_examples)
    return {key: resolved[key] for key in ("dataset", "examples", "reward_fn") if key in resolved}


def resolve_data(config: dict[str, Any], env_kwargs: dict[str, Any], takes_examples: bool = True) -> dict[str, Any]:
    """
    Fill in the texts of a config that name data, and select its episodes. In ``dataset``, ``examples``, ``episodes`` and
    ``labels``, ``{name}`` stands for the environment's keyword argument of that name, so that ``source: "{task}"`` serves all
    tasks.

    :param config: hyperparameters. ``dataset`` and ``examples`` may be anything that the constructors take. ``episodes``
        holds arguments of :func:`~sb3_offline.data.selection.select_episodes`; or ``detected``, which is ``true`` for the
        episodes that look like the examples or a number of the best of these. ``reward_fn: detected`` gives the steps that do
        a reward of 1. Both take ``labels``, a file of ``sb3-offline label``, or make labels from ``examples``. Given both, the
        file is made by the first run, and read by all later ones.
    :param env_kwargs: keyword arguments of the environment
    :param takes_examples: whether the algorithm itself learns from examples. Otherwise, ``examples`` that were used for labels
        are left out
    :return: the config with these texts filled in. It has no ``episodes`` and no ``labels``: its ``dataset`` holds only the
        selected episodes, and its ``reward_fn`` the labels.
    """
    resolved = dict(config)
    for key in DATA_ENTRIES:
        if key in config:
            resolved[key] = _fill_in(config[key], key, env_kwargs)
    episodes, labels = resolved.pop("episodes", None), resolved.pop("labels", None)
    if episodes is not None:
        if resolved.get("dataset") is None:
            raise RuntimeError("The config selects `episodes`, but names no `dataset`: add it (--dataset)")
        resolved["dataset"] = _selected(resolved["dataset"], episodes, labels, resolved.get("examples"))
    if config.get("reward_fn") == "detected":
        if resolved.get("dataset") is None:
            raise RuntimeError("The config's `reward_fn` is detected, but it names no `dataset`: add it (--dataset)")
        resolved["dataset"] = open_datasets(resolved["dataset"])
        resolved["reward_fn"] = given_labels(resolved["dataset"], labels, resolved.get("examples"))
    if uses_labels(config) and not takes_examples:
        resolved.pop("examples", None)
    return resolved


def _selected(dataset: Any, episodes: Any, labels: Any, examples: Any) -> Any:
    """:return: the datasets with only these episodes"""
    asked = episodes if isinstance(episodes, dict) else {}
    number = asked.get("detected")
    if "detected" in asked and (len(asked) > 1 or not (number is True or (type(number) is int and number > 0))):
        remedy = "give `detected` alone, as true or a number of episodes"
        raise RuntimeError(f"The config's `episodes` is {episodes!r}; {remedy}: labels are made from all of the data")
    if "detected" in asked:
        return select_detected(dataset, asked["detected"], labels=labels, examples=examples)
    try:
        return select_episodes(dataset, **episodes)
    except TypeError as error:
        problem = f"The config's `episodes` is {episodes!r}; give it `source` and `success`, or `detected` ({error})"
        raise RuntimeError(problem) from error


def _fill_in(value: Any, key: str, env_kwargs: dict[str, Any]) -> Any:
    if isinstance(value, dict):
        return {name: _fill_in(part, key, env_kwargs) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [_fill_in(part, key, env_kwargs) for part in value]
    if not isinstance(value, str):
        return value
    try:
        return value.format(**env_kwargs)
    except KeyError as error:
        remedy = "add it to the environment's keyword arguments (--task, or --env-kwargs of the RL Zoo)"
        problem = f"The config's `{key}` names {error}, which is not an argument of the environment"
        raise RuntimeError(f"{problem}: {remedy}") from error
    except (AttributeError, IndexError, ValueError) as error:
        raise RuntimeError(f"The config's `{key}` is {value!r}: {error}; write {{{{ for a literal brace") from error
