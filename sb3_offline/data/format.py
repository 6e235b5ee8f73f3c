"""
The dataset format, version 1. The page docs/dataset_format.md describes it in words.

One HDF5 file holds E episodes with N steps in total. Arrays are flat over all steps. Each episode has one more row of
observations than it has steps, so that no observation is stored twice.
"""

import json
import operator
import os
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import h5py
import numpy as np
from gymnasium import spaces

from sb3_offline.data.errors import DatasetError
from sb3_offline.data.plain import check_plain, is_text, read_attribute
from sb3_offline.data.spaces import space_from_json, space_to_json, subspaces

FORMAT = "sb3-offline-dataset"
FORMAT_VERSION = 1
# Size of a chunk in compressed storage. These are 50 frames of 64x64x3: gzip finds the previous frames in its window, and a
# chunk fits into HDF5's default chunk cache of 1 MiB.
CHUNK_BYTES = 50 * 64 * 64 * 3

# Kinds of dtypes of extras: flags, numbers, and texts of a fixed length. Others, such as references, records and texts of
# variable length, would point to other places in the file.
EXTRA_KINDS = "biufS"

# The checksums: an array with a row for each episode, and attributes that later writers and readers of version 1 may lack.
CHECKSUMS = "episodes/crc"
COLUMNS, ATTRIBUTES_CRC = "crc_fields", "crc_attributes"

Storage = Literal["contiguous", "compressed"]


class Field(NamedTuple):
    """
    One array of the file.

    :param per: the unit that has one row: "episode" (E rows), "step" (N rows) or "observation" (N + E rows)
    :param shape: shape of one row
    :param dtype: dtype of the values
    """

    per: Literal["episode", "step", "observation"]
    shape: tuple[int, ...]
    dtype: np.dtype

    def rows(self, n_episodes: int, n_steps: int) -> int:
        """
        :param n_episodes: number of episodes
        :param n_steps: number of steps in all episodes
        :return: number of rows of the array
        """
        return {"episode": n_episodes, "step": n_steps, "observation": n_steps + n_episodes}[self.per]

    @property
    def row_bytes(self) -> int:
        """:return: size of one row, in bytes"""
        return int(np.prod(self.shape, dtype=np.int64)) * self.dtype.itemsize


@dataclass
class Header:
    """
    The attributes of a file, and which of the optional arrays it has.

    :param observation_space: space of one observation
    :param action_space: space of one action
    :param env_id: gymnasium ID of the environment, or ""
    :param env_kwargs: keyword arguments of the environment (JSON)
    :param provenance: origin of the data: program, command, seed, versions, policy, ... (JSON)
    :param sources: labels of the episodes' sources, e.g. names of scripted policies; ``None`` if episodes have no labels
    :param rewards: whether the file has rewards
    :param success: whether the file has success labels
    :param extras: further arrays with one row for each step: name to (shape of one row, dtype)
    """

    observation_space: spaces.Space
    action_space: spaces.Space
    env_id: str = ""
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    provenance: dict[str, Any] = field(default_factory=dict)
    sources: list[str] | None = None
    rewards: bool = True
    success: bool = True
    extras: Mapping[str, tuple[tuple[int, ...], Any]] = field(default_factory=dict)

    def fields(self) -> dict[str, Field]:
        """:return: all arrays of the file but ``n_episodes``, by their HDF5 names"""
        episode_dtypes = {"length": np.int64, "seed": np.int64}
        if self.sources is not None:
            episode_dtypes["source"] = np.int16
        fields = {f"episodes/{name}": Field("episode", (), np.dtype(dtype)) for name, dtype in episode_dtypes.items()}
        for name, space in subspaces(self.observation_space, "observations").items():
            fields[name] = Field("observation", tuple(space.shape or ()), np.dtype(space.dtype))
        if isinstance(self.action_space, spaces.Dict):
            raise DatasetError("", "action_space", "is a Dict", "Flatten the actions (gymnasium.ActionWrapper)")
        action_dtype = np.float32 if isinstance(self.action_space, spaces.Box) else self.action_space.dtype
        fields["actions"] = Field("step", tuple(self.action_space.shape or ()), np.dtype(action_dtype))
        if self.rewards:
            fields["rewards"] = Field("step", (), np.dtype(np.float32))
        for name in ("terminated", "truncated") + (("success",) if self.success else ()):
            fields[name] = Field("step", (), np.dtype(bool))
        for name, declared in self.extras.items():
            fields[f"extras/{name}"] = _extra_field(name, declared)
        return fields

    def attributes(self) -> dict[str, Any]:
        """:return: the attributes of the file"""
        attributes = {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "observation_space": space_to_json(self.observation_space),
            "action_space": space_to_json(self.action_space),
            "env_id": self.env_id,
            "env_kwargs": json.dumps(self.env_kwargs),
            "provenance": json.dumps(self.provenance),
        }
        return attributes if self.sources is None else {**attributes, "sources": json.dumps(self.sources)}


def _extra_field(name: str, declared: Any) -> Field:
    """:return: the field of an extra; raises ``DatasetError`` if a file cannot hold it as a plain array"""
    field = f"extras/{name}"
    if not isinstance(name, str) or name in ("", ".", "..") or "/" in name or "\0" in name:
        raise DatasetError("", field, "is no name of an array", "Give a name without a slash")
    try:
        shape, dtype = declared
        spec = Field("step", tuple(operator.index(size) for size in shape), np.dtype(dtype))
    except (TypeError, ValueError) as error:
        raise DatasetError("", field, f"is declared as {declared!r:.100}", "Give (shape of one row, dtype)") from error
    if spec.dtype.kind not in EXTRA_KINDS or spec.dtype.itemsize == 0 or min(spec.shape, default=0) < 0:
        problem = f"has rows of shape {spec.shape} and dtype {spec.dtype}"
        raise DatasetError("", field, problem, "Use numbers, flags, or texts of a fixed length ('S10')")
    return spec


def read_header(file: h5py.File, path: str | os.PathLike) -> Header:
    """
    :param file: an open file of this format
    :param path: its path, for error messages
    :return: its header
    :raises DatasetError: if the format is another one, the version is newer, or an attribute cannot be read
    """
    found = read_attribute(file, "format")
    if not is_text(found, FORMAT):
        problem = f"is {found!r}, expected {FORMAT!r}"
        remedy = "Give a dataset written by DatasetWriter, or convert the file first (sb3-offline convert)"
        raise DatasetError(path, "attribute format", problem, remedy)
    version = read_attribute(file, "format_version")
    is_number = isinstance(version, np.integer)
    if not is_number or version != FORMAT_VERSION:
        remedy = "Update sb3-offline" if is_number and version > FORMAT_VERSION else "Convert the file again"
        raise DatasetError(path, "attribute format_version", f"is {version}, this release reads {FORMAT_VERSION}", remedy)

    def attribute(name: str, decode: Callable[[str], Any]) -> Any:
        try:
            value = file.attrs[name]
            if not isinstance(value, str):
                raise TypeError(f"it is of type {type(value).__name__}, not a text")
            return decode(value)
        except Exception as error:  # spaces check their arguments in several ways
            problem = "is missing" if name not in file.attrs else f"cannot be understood ({error})"
            raise DatasetError(path, f"attribute {name}", problem, "Write the file again with DatasetWriter") from error

    check_plain(file, path, ["extras"])
    extras = file.get("extras", {})
    if not isinstance(extras, h5py.Group | dict):
        raise DatasetError(path, "extras", "is an array, not a group of arrays", "Write the file again with DatasetWriter")
    declared = {}
    for name in extras:
        check_plain(file, path, [f"extras/{name}"])
        array = extras[name]
        if not isinstance(array, h5py.Dataset) or array.shape is None:
            problem = "is not an array with rows"
            raise DatasetError(path, f"extras/{name}", problem, "Write the file again with DatasetWriter")
        declared[name] = (array.shape[1:], array.dtype)
    header = Header(
        observation_space=attribute("observation_space", space_from_json),
        action_space=attribute("action_space", space_from_json),
        env_id=attribute("env_id", str),
        env_kwargs=attribute("env_kwargs", _decode_dict),
        provenance=attribute("provenance", _decode_dict),
        sources=attribute("sources", _decode_texts) if "sources" in file.attrs else None,
        rewards="rewards" in file,
        success="success" in file,
        extras=declared,
    )
    try:
        header.fields()
    except DatasetError as error:
        raise DatasetError(path, error.field, error.problem, "Write the file again with DatasetWriter") from error
    return header


def _decode_dict(text: str) -> dict[str, Any]:
    value = json.loads(text)
    if not isinstance(value, dict):
        raise TypeError(f"it is a JSON {type(value).__name__}, not an object")
    return value


def _decode_texts(text: str) -> list[str]:
    value = json.loads(text)
    if not isinstance(value, list) or not all(isinstance(label, str) for label in value):
        raise TypeError("it is not a JSON list of texts")
    if len(set(value)) < len(value):
        raise ValueError("it holds a label twice")
    return value


def checksum_columns(fields: Mapping[str, Field]) -> list[str]:
    """
    :param fields: the arrays of a file
    :return: their names, in the order of the columns of their checksums
    """
    return sorted(fields)


def checksum_field(fields: Mapping[str, Field]) -> Field:
    """
    :param fields: the arrays of a file
    :return: the array of their checksums
    """
    return Field("episode", (len(fields),), np.dtype(np.uint32))


def attributes_crc(attributes: Mapping[str, Any]) -> int:
    """
    :param attributes: the attributes of a file, without their checksum
    :return: their checksum (CRC-32)
    """
    lines = "".join(f"{name}={attributes[name]}\n" for name in sorted(attributes))
    return zlib.crc32(lines.encode(errors="surrogatepass"))


def create_file(
    path: Path, header: Header, n_episodes: int, n_steps: int, *, committed: int, storage: Storage = "contiguous"
) -> None:
    """
    Create a file with room for a number of episodes and steps. Contiguous arrays get their places in the file but are not
    written, so that they take no space on disk before rows are written to them.

    :param path: file to create or overwrite
    :param header: attributes and arrays
    :param n_episodes: number of episodes that there is room for
    :param n_steps: number of steps that there is room for
    :param committed: number of episodes that exist, the value of ``n_episodes`` in the file
    :param storage: "contiguous" (for training) or "compressed" (for keeping and sending)
    :raises TypeError: if there is no such storage
    """
    if storage not in get_args(Storage):
        raise TypeError(f"storage is {storage!r}; choose 'contiguous' or 'compressed'")
    # Arrays begin at whole pages, so that reading a memory-mapped row touches as few pages as possible.
    with h5py.File(path, "w", locking=False, alignment_threshold=4096, alignment_interval=4096) as file:
        fields = header.fields()
        attributes = {**header.attributes(), COLUMNS: json.dumps(checksum_columns(fields))}
        for name, value in {**attributes, ATTRIBUTES_CRC: np.uint32(attributes_crc(attributes))}.items():
            file.attrs[name] = value
        for name, spec in {**fields, CHECKSUMS: checksum_field(fields)}.items():
            _create_array(file, name, (spec.rows(n_episodes, n_steps), *spec.shape), spec, storage)
        _create_array(file, "n_episodes", (), Field("episode", (), np.dtype(np.int64)), "contiguous")
        file["n_episodes"][()] = committed


def _create_array(file: h5py.File, name: str, shape: tuple[int, ...], spec: Field, storage: Storage) -> None:
    if storage == "compressed" and 0 not in shape:
        chunk = min(max(CHUNK_BYTES // max(spec.row_bytes, 1), 1), shape[0])
        options: dict[str, Any] = {"chunks": (chunk, *spec.shape), "compression": "gzip", "shuffle": True}
        file.create_dataset(name, shape, spec.dtype, **options)
        return
    plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plist.set_layout(h5py.h5d.CONTIGUOUS)
    plist.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    plist.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    plist.set_obj_track_times(False)  # the same data give the same file, byte for byte
    group, _, leaf = name.rpartition("/")
    parent = file.require_group(group) if group else file
    h5py.h5d.create(
        parent.id, leaf.encode(), h5py.h5t.py_create(spec.dtype, logical=True), h5py.h5s.create_simple(shape), plist
    )
