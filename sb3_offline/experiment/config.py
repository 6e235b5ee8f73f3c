"""Read hyperparameters from YAML files in the form of the RL Zoo, with one section per environment id."""

import ast
import math
import re
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import yaml


class _Loader(yaml.SafeLoader):
    """
    Reads 3e-4 as a number, as YAML 1.2 and Python do, and not as text. Refuses keys that a section holds twice, of which one
    would be lost without a word, and numbers that are not finite.
    """

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """See PyYAML."""
        seen: set[str] = set()
        for key, _ in node.value:
            name = str(key.value)
            if name in seen and name != "<<":
                problem = f"the key {name!r} is there twice; keep one"
                raise yaml.constructor.ConstructorError(None, None, problem, key.start_mark)
            seen.add(name)
        return super().construct_mapping(node, deep=deep)

    def construct_yaml_float(self, node: yaml.ScalarNode) -> float:
        """See PyYAML."""
        value = super().construct_yaml_float(node)
        if not math.isfinite(value):
            problem = f"the value {node.value} is no finite number; give one"
            raise yaml.constructor.ConstructorError(None, None, problem, node.start_mark)
        return value


_FLOAT = re.compile(r"[-+]?[0-9]+[eE][-+]?[0-9]+$")
_Loader.add_constructor("tag:yaml.org,2002:float", _Loader.construct_yaml_float)
_Loader.add_implicit_resolver("tag:yaml.org,2002:float", _FLOAT, list("-+0123456789"))


def config_path(name: str) -> Path:
    """
    :param name: name of a file that comes with the package (``"ceborl"``), or the path of any YAML file
    :return: path of the file
    """
    own = Path(name)
    if own.suffix in (".yml", ".yaml"):
        return own
    return Path(str(resources.files("sb3_offline.zoo_configs") / f"{name}.yml"))


def read_yaml(name: str, kind: str, folder: str = "") -> tuple[Path, Any]:
    """
    :param name: a YAML file, or the name of a shipped one
    :param kind: kind of the file, for the error message if it is missing
    :param folder: folder of the shipped files inside ``zoo_configs``, with a slash at its end
    :return: path of the file, and its content
    """
    path = config_path(name if Path(name).suffix else folder + name)
    if not path.is_file():
        shipped = sorted(file.stem for file in config_path(f"{folder}any").parent.glob("*.yml"))
        raise RuntimeError(f"{path}: there is no such {kind}; give a path, or one of {', '.join(shipped)}")
    try:
        return path, yaml.load(path.read_text(encoding="utf-8"), _Loader)
    except (yaml.YAMLError, ValueError, RecursionError, OverflowError, TypeError, OSError) as error:
        raise RuntimeError(f"{path}: is not YAML that can be used ({' '.join(str(error).split())})") from error


def load_config(name: str, env_id: str) -> dict[str, Any]:
    """
    :param name: see :func:`config_path`
    :param env_id: section to read; if the file has no such section, it is ``default``
    :return: constructor arguments of the algorithm, ``policy`` among them, and ``n_timesteps`` and ``env_kwargs``; raises
        ``RuntimeError`` if the file or the section is missing or wrong
    """
    path, sections = read_yaml(name, "config file")
    if not isinstance(sections, dict):
        raise RuntimeError(f"{path}: has no sections; write `{env_id}:` and the hyperparameters below it, indented")
    section = sections.get(env_id, sections.get("default"))
    if not isinstance(section, dict):
        raise RuntimeError(f"{path}: has no section {env_id!r} and no 'default'; its sections are {sorted(sections)}")
    missing = {"policy", "n_timesteps"} - section.keys()
    if missing:
        raise RuntimeError(f"{path}: its section for {env_id} lacks {', '.join(sorted(missing))}; add it")
    config = dict(section)
    if isinstance(config.get("policy_kwargs"), str):  # files of the RL Zoo write Python: "dict(net_arch=[64, 64])"
        config["policy_kwargs"] = python_value(config["policy_kwargs"])
    for name in ("policy_kwargs", "env_kwargs"):
        if config.get(name) is None:
            config.pop(name, None)
        elif not isinstance(config[name], dict):
            remedy = "write its entries below it, indented, or dict(name=literal)"
            raise RuntimeError(f"{path}: {name} of {env_id} is {config[name]!r}; {remedy}")
    return config


def parse_overrides(pairs: Sequence[str]) -> dict[str, Any]:
    """
    :param pairs: ``key:value``, as in the RL Zoo's ``--hyperparams``. Values are Python literals or ``dict(name=literal)``;
        any other text is a string.
    :return: values by key
    """
    overrides = {}
    for pair in pairs:
        key, colon, text = pair.partition(":")
        if not colon or not key:
            raise RuntimeError(f"{pair!r} is not of the form key:value")
        overrides[key] = python_value(text)
    return overrides


def python_value(text: str) -> Any:
    """
    :param text: text from a file of the RL Zoo
    :return: the value of a Python literal or of ``dict(name=literal)``; any other text unchanged
    """
    try:
        return _literal(ast.parse(text.strip(), mode="eval").body)
    except (ValueError, SyntaxError):
        return text


def _literal(node: ast.expr) -> Any:
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "dict" and not node.args:
        return {str(keyword.arg): _literal(keyword.value) for keyword in node.keywords}
    return ast.literal_eval(node)


def number_or_text(value: Any) -> Any:
    """
    :param value: value that a YAML 1.1 loader, such as the RL Zoo's, read from a file
    :return: the value that this module's loader reads: a number in place of the text "3e-4"
    """
    return float(value) if isinstance(value, str) and _FLOAT.match(value) else value
