"""Hyperparameters from YAML files in the form of the RL Zoo: a section per environment id."""

import ast
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import yaml


def config_path(name: str) -> Path:
    """
    :param name: a file that comes with the package (``"ceborl"``), or a path of one's own
    :return: the file
    """
    own = Path(name)
    if own.suffix in (".yml", ".yaml"):
        return own
    return Path(str(resources.files("sb3_offline.zoo_configs") / f"{name}.yml"))


def load_config(name: str, env_id: str) -> dict[str, Any]:
    """
    :param name: see :func:`config_path`
    :param env_id: section to read; ``default`` where the file has no such section
    :return: constructor arguments of the algorithm, and ``policy``, ``n_timesteps``, ``env_kwargs``
    """
    path = config_path(name)
    if not path.is_file():
        shipped = sorted(file.stem for file in config_path("ceborl").parent.glob("*.yml"))
        raise RuntimeError(f"{path}: there is no such config file; give a path, or one of {', '.join(shipped)}")
    with path.open() as file:
        sections = yaml.safe_load(file)
    section = (sections or {}).get(env_id, (sections or {}).get("default"))
    if not isinstance(section, dict):
        raise RuntimeError(f"{path}: has no section {env_id!r} and no 'default'; its sections are {sorted(sections or {})}")
    return dict(section)


def parse_overrides(pairs: Sequence[str]) -> dict[str, Any]:
    """
    :param pairs: ``key:value`` as in the RL Zoo's ``--hyperparams``; values are Python literals, or else strings
    :return: the same as a dict
    """
    overrides = {}
    for pair in pairs:
        key, colon, text = pair.partition(":")
        if not colon or not key:
            raise RuntimeError(f"{pair!r} is not of the form key:value")
        try:
            overrides[key] = ast.literal_eval(text)
        except (ValueError, SyntaxError):
            overrides[key] = text
    return overrides
