"""What a path or an object contains, found out without running or loading any of it."""

import itertools
import json
import pickletools
import zipfile
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import h5py

from sb3_offline.data.errors import DatasetError
from sb3_offline.data.files import open_hdf5

Kind = Literal["object", "folder", "HDF5", "zip", "pickle", "other"]

HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
HDF5_SIGNATURE_OFFSETS = (0, 512, 1024, 2048)
EXPECTED_KINDS: dict[str, Kind] = {
    ".h5": "HDF5",
    ".hdf5": "HDF5",
    ".npz": "zip",
    ".zip": "zip",
    ".pkl": "pickle",
    ".pickle": "pickle",
}
MAX_OPCODES = 40
MAX_NAMES = 12


class Probe:
    """
    A path or an object that is given as a dataset. Formats look at its contents here, and read from here.

    Everything is found out when it is first asked for. Use it as a context manager: it closes the HDF5 file that it opened.

    :param given: path of an existing file or folder, or any other object
    """

    def __init__(self, given: Any):
        self.given = given
        self.is_object = not isinstance(given, Path)
        self.path: Path = Path(f"<{type(given).__name__}>") if self.is_object else given
        """The path, or for an object a text that names its type in messages."""

    def __enter__(self) -> "Probe":
        return self

    def __exit__(self, *exc_info: Any) -> None:
        self.close()

    def close(self) -> None:
        """Close the HDF5 file, e.g. before another library opens it: HDF5 may refuse to open a file a second time."""
        if "hdf5" in self.__dict__ and self.hdf5 is not None:
            self.hdf5.close()

    @cached_property
    def head(self) -> bytes:
        """The first bytes of a file."""
        try:
            with open(self.path, "rb") as file:
                return file.read(max(HDF5_SIGNATURE_OFFSETS) + len(HDF5_SIGNATURE))
        except OSError as error:
            raise DatasetError(self.path, "file", f"cannot be read ({error})", "Check that you may read it") from error

    @cached_property
    def kind(self) -> Kind:
        """The container: a live object, a folder, or a kind of file that is told from its first bytes."""
        if self.is_object:
            return "object"
        if self.path.is_dir():
            return "folder"
        if any(self.head.startswith(HDF5_SIGNATURE, offset) for offset in HDF5_SIGNATURE_OFFSETS):
            return "HDF5"
        if self.head.startswith((b"PK\x03\x04", b"PK\x05\x06")):
            return "zip"
        # The opcode PROTO, which pickles of protocol 2 and later begin with
        return "pickle" if self.head[:1] == b"\x80" and self.head[1:2] <= b"\x05" else "other"

    @cached_property
    def hdf5(self) -> h5py.File | None:
        """The open HDF5 file; ``None`` for anything else. Raises ``DatasetError`` if the file is damaged."""
        return open_hdf5(self.path) if self.kind == "HDF5" else None

    @cached_property
    def names(self) -> frozenset[str]:
        """
        Names of the parts at the top level: HDF5 keys, arrays of an ``.npz`` file (without ".npy"), members of another zip
        archive, files and folders in a folder, or those keys of a dict that are texts.
        """
        if self.hdf5 is not None:
            return frozenset(self.hdf5)
        if self.kind == "folder":
            return frozenset(entry.name for entry in self.path.iterdir())
        if self.kind == "zip":
            try:
                with zipfile.ZipFile(self.path) as archive:
                    return frozenset(name.removesuffix(".npy") for name in archive.namelist())
            except zipfile.BadZipFile:
                return frozenset()
        return frozenset(key for key in self.given if isinstance(key, str)) if isinstance(self.given, Mapping) else frozenset()

    @cached_property
    def pickled(self) -> str:
        """
        Type of the object in a pickle, told from the first opcodes: "list", "dict", or "module.Class". "" if it is of another
        kind, or no pickle.
        """
        if self.kind != "pickle":
            return ""
        texts: list[str] = []
        with open(self.path, "rb") as file:
            try:
                for opcode, argument, _ in itertools.islice(pickletools.genops(file), MAX_OPCODES):
                    if opcode.name in ("EMPTY_LIST", "EMPTY_DICT"):
                        return opcode.name.removeprefix("EMPTY_").lower()
                    if opcode.name == "GLOBAL":
                        return str(argument).replace(" ", ".")
                    if opcode.name == "STACK_GLOBAL":
                        return ".".join(texts[-2:])
                    if "UNICODE" in opcode.name:
                        texts.append(str(argument))
            except ValueError:  # not a pickle after all
                pass
        return ""

    def json(self, name: str) -> Any:
        """
        :param name: of a file in the folder
        :return: its contents; ``None`` if there is no such file, or if it is not JSON
        """
        try:
            with open(self.path / name, encoding="utf-8") as file:
                return json.load(file)
        except (OSError, ValueError):
            return None

    def describe(self) -> str:
        """:return: the contents in words, for messages"""
        if self.kind == "object":
            words = f"an object of type {type(self.given).__module__}.{type(self.given).__qualname__}"
            return words + (f" with the keys {self._listed()}" if self.names else "")
        if self.kind == "folder":
            return f"a folder with {self._listed()}" if self.names else "an empty folder"
        if self.hdf5 is not None:
            attributes = [f"{key}={value!r}" for key, value in self.hdf5.attrs.items() if key.startswith("format")]
            found = f"an HDF5 file with the keys {self._listed()}" if self.names else "an HDF5 file without arrays"
            return found + (f" and the attributes {', '.join(attributes)}" if attributes else "")
        if self.kind == "zip":
            return f"a zip archive (or .npz file) with {self._listed()}" if self.names else "an empty or damaged zip archive"
        if self.kind == "pickle":
            return f"a pickle with an object of type {self.pickled}" if self.pickled else "a pickle of some other kind"
        if not self.head:
            return "an empty file"
        return f"neither HDF5, nor a zip archive, nor a pickle, but begins with {self.head[:20]!r}"

    def promised_kind(self) -> str:
        """:return: the kind of file that the name promises, where the contents are of another kind; else an empty text"""
        promised = "" if self.kind in ("object", "folder") else EXPECTED_KINDS.get(self.path.suffix.lower(), "")
        return promised if promised != self.kind else ""

    def _listed(self) -> str:
        names = sorted(self.names)
        more = f", ... ({len(names)} in all)" if len(names) > MAX_NAMES else ""
        return ", ".join(names[:MAX_NAMES]) + more
