"""The data that a config names."""

from typing import Any

from sb3_offline.data.selection import select_episodes


def resolve_data(config: dict[str, Any], env_kwargs: dict[str, Any]) -> dict[str, Any]:
    """
    Say which data a config means. In the texts of its ``dataset``, ``examples`` and ``episodes``, ``{name}`` stands for the
    environment's keyword argument of that name, so that ``source: "{task}"`` serves all tasks.

    :param config: hyperparameters; ``dataset`` and ``examples`` may be anything that the constructors take, ``episodes`` are
        arguments of :func:`~sb3_offline.data.selection.select_episodes`
    :param env_kwargs: of the environment
    :return: the config with these texts filled in, and without ``episodes``: its dataset has them alone
    """
    resolved = dict(config)
    for key in {"dataset", "examples", "episodes"} & config.keys():
        resolved[key] = _fill_in(config[key], key, env_kwargs)
    episodes = resolved.pop("episodes", None)
    if episodes is not None:
        if resolved.get("dataset") is None:
            raise RuntimeError("The config chooses `episodes`, but names no `dataset`: add it (--dataset)")
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
        raise RuntimeError(f"The config's `{key}` names {error}, which the environment is not given: {remedy}") from error
    except (AttributeError, IndexError, ValueError) as error:
        raise RuntimeError(f"The config's `{key}` says {value!r}: {error}; write {{{{ for a brace that is meant") from error
