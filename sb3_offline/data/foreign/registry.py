"""Which formats there are, and which of them a path, a name or an object has."""

import contextlib
import functools
import importlib
import os
import pkgutil
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import sb3_offline.data.foreign as folder
from sb3_offline.data.errors import DatasetError
from sb3_offline.data.foreign.base import Foreign, Format, Options
from sb3_offline.data.foreign.probe import Probe
from sb3_offline.data.format import FORMAT as NATIVE_FORMAT
from sb3_offline.data.format import Header


@functools.cache
def known_formats() -> tuple[Format, ...]:
    """:return: the formats of all modules in this folder, in the order of the modules' names"""
    names = sorted(module.name for module in pkgutil.iter_modules(folder.__path__))
    modules = [importlib.import_module(f"{folder.__name__}.{name}") for name in names]
    return tuple(module.FORMAT for module in modules if isinstance(getattr(module, "FORMAT", None), Format))


def format_of_name(name: str) -> Format | None:
    """
    :param name: a path, or a name such as "minari:namespace/name-v0"
    :return: the format whose prefix the name has; ``None`` for a path
    """
    return next((known for known in known_formats() if known.scheme and name.startswith(known.scheme.prefix)), None)


def find_path(dataset: str | os.PathLike) -> Path:
    """
    :param dataset: a path, which may begin with ``~``, or a name such as "minari:namespace/name-v0"
    :return: absolute path of the file or folder
    :raises DatasetError: if it does not exist
    """
    name = os.fspath(dataset)
    known = format_of_name(name)
    if known is not None and known.scheme is not None:
        short = name.removeprefix(known.scheme.prefix)
        with _extra_named(known, name):
            path = known.scheme.locate(short)
        if not path.exists():
            remedy = f"Check the name, or download the dataset: {known.scheme.download.format(name=short)}"
            raise DatasetError(path, "dataset", "does not exist", remedy)
        return path
    path = Path(name).expanduser().absolute()
    if not path.exists():
        schemes = {known.name: known.scheme for known in known_formats() if known.scheme}
        hints = [f"give {s.prefix}{name} for a dataset of {n}" for n, s in schemes.items() if re.fullmatch(s.pattern, name)]
        raise DatasetError(path, "file", "does not exist", ", or ".join(["Check the path", *hints]))
    return path


def recognize(probe: Probe) -> Format | None:
    """
    :param probe: a path or an object
    :return: its format; ``None`` if it has no known one
    :raises DatasetError: if several formats recognise it, none of which refines the others
    """
    found = [known for known in known_formats() if known.recognizes(probe)]
    refined = {name for known in found for name in known.refines}
    found = [known for known in found if known.name not in refined]
    if len(found) > 1:
        problem = f"may have any of the formats {', '.join(known.name for known in found)}"
        raise DatasetError(probe.path, "format", problem, "Convert the data to one of them with its own library")
    return found[0] if found else None


def unknown_format(probe: Probe) -> DatasetError:
    """
    :param probe: a path or an object that no format recognises
    :return: the error that says what was found and which formats are known
    """
    formats = {"sb3-offline": f"an HDF5 file with the attribute format={NATIVE_FORMAT!r}"}
    formats |= {known.name: known.description for known in known_formats()}
    remedy = "The known formats are: " + "; ".join(f"{name} ({description})" for name, description in formats.items())
    if probe.kind == "folder":
        remedy = f"Give a file or a pattern of files (folder/*.h5), or a folder of a known format. {remedy}"
    elif promised := probe.promised_kind():
        remedy = f"Check that the file is complete, since its name promises a {promised} file. {remedy}"
    elif probe.is_object:
        remedy = (
            "Give a path, an OfflineDataset, a ReplayBuffer of SB3, a MinariDataset, a dict of arrays with D4RL's names, a "
            "list of trajectory dicts, or a list of paths; or write the data to a file with sb3_offline.DatasetWriter. "
            f"{remedy}"
        )
    field = probe.kind if probe.kind in ("object", "folder") else "file"
    return DatasetError(probe.path, field, f"has no known format: it is {probe.describe()}", remedy)


def read_foreign(known: Format, probe: Probe, options: Options) -> Foreign:
    """
    :param known: the format of the data
    :param probe: the path or the object
    :param options: what the caller declares, for data that do not declare it themselves
    :return: the data, in memory
    :raises DatasetError: if the data are damaged, or if reading them needs an option or a package that is missing
    """
    try:
        with _extra_named(known, probe.path):
            return known.read(probe, options)
    except DatasetError as error:
        if error.file:
            raise
        raise DatasetError(probe.path, error.field, error.problem, error.remedy) from error


def write_foreign(known: Format, header: Header, arrays: Mapping[str, Any], name: str) -> None:
    """
    :param known: a format whose prefix the name has
    :param header: of the dataset
    :param arrays: of the dataset, by name
    :param name: of the dataset to write, with the prefix
    :raises DatasetError: if the format cannot be written, if there is such a dataset, or if a package is missing
    """
    if known.write is None:
        raise DatasetError(name, "format", f"{known.name} can be read, but not written", "Give the path of a file instead")
    with _extra_named(known, name):
        known.write(header, arrays, name)


@contextlib.contextmanager
def _extra_named(known: Format, place: str | os.PathLike) -> Iterator[None]:
    """Turn the error about a package that is not installed into one that names the extra that installs it."""
    try:
        yield
    except ModuleNotFoundError as error:
        if not known.extra:
            raise
        remedy = f'Install it with: pip install "sb3-offline[{known.extra}]"'
        raise DatasetError(place, "format", f"{known.name} needs the package {error.name}", remedy) from error
