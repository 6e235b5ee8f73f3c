"""The dataset and the success examples that a config names."""

from typing import Any

from sb3_offline.data.selection import select_episodes


def given_data(dataset: Any, examples: Any) -> dict[str, Any]:
    """
    :param dataset: dataset path(s) that replace those of a config, or ``None``
    :param examples: success examples that replace those of a config, or ``None``
    :return: the entries of the config that are replaced
    """
    return {key: value for key, value in (("dataset", dataset), ("examples", examples)) if value is not None}


def data_arguments(config: dict[str, Any], dataset: Any = None, examples: Any = None) -> dict[str, Any]:
    """
    :param config: hyperparameters
    :param dataset: dataset path(s) (default: those of the config)
    :param examples: success examples (default: those of the config)
    :return: the arguments ``dataset`` and ``examples`` of a model's constructor, and of its ``load``, as far as they are known
    """
    resolved = resolve_data({**config, **given_data(dataset, examples)}, config.get("env_kwargs", {}))
    return {key: resolved[key] for key in ("dataset", "examples") if key in resolved}


def resolve_data(config: dict[str, Any], env_kwargs: dict[str, Any]) -> dict[str, Any]:
    """
    Fill in the texts of a config that name data, and select its episodes. In ``dataset``, ``examples`` and ``episodes``,
    ``{name}`` stands for the environment's keyword argument of that name, so that ``source: "{task}"`` serves all tasks.

    :param config: hyperparameters. ``dataset`` and ``examples`` may be anything that the constructors take, and ``episodes``
        holds arguments of :func:`~sb3_offline.data.selection.select_episodes`.
    :param env_kwargs: keyword arguments of the environment
    :return: the config with these texts filled in. It has no ``episodes``: its ``dataset`` holds only the selected ones.
    """
    resolved = dict(config)
    for key in {"dataset", "examples", "episodes"} & config.keys():
        resolved[key] = _fill_in(config[key], key, env_kwargs)
    episodes = resolved.pop("episodes", None)
    if episodes is not None:
        if resolved.get("dataset") is None:
            raise RuntimeError("The config selects `episodes`, but names no `dataset`: add it (--dataset)")
        try:
            resolved["dataset"] = select_episodes(resolved["dataset"], **episodes)
        except TypeError as error:
            problem = f"The config's `episodes` is {episodes!r}; give it `source` and `success` ({error})"
            raise RuntimeError(problem) from error
    return resolved


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
