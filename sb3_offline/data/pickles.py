"""Pickles opened without consent: only such as build plain values of known libraries, and run no code of their own."""

import base64
import enum
import importlib
import io
import json
import pickle
import zipfile
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import BaseBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule

from sb3_offline.data.errors import DatasetError

# What pickles of arrays, generators and tensors call.
_CALLABLES = {
    "builtins": {"set", "frozenset", "bytearray", "complex", "range", "slice", "object", "list", "dict", "tuple"}
    | {"int", "float", "str", "bytes", "bool"},
    "copyreg": {"_reconstructor"},
    "collections": {"OrderedDict", "deque", "defaultdict"},
    "datetime": {"datetime", "timedelta"},
    "numpy": {"dtype", "ndarray"},
    "numpy.random._pickle": {"__generator_ctor", "__bit_generator_ctor", "__randomstate_ctor"},
    "numpy.random._pcg64": {"PCG64"},
    "numpy.random._mt19937": {"MT19937"},
    "numpy.random.bit_generator": {"SeedSequence", "__pyx_unpickle_SeedSequence"},
    "torch": {"device", "Size"},
    "torch._utils": {"_rebuild_tensor_v2", "_rebuild_parameter"},
}
for _core in ("numpy.core", "numpy._core"):
    _CALLABLES[f"{_core}.multiarray"] = {"_reconstruct", "scalar"}
    _CALLABLES[f"{_core}.numeric"] = {"_frombuffer"}
# Modules whose classes of the kinds below hold values, and run nothing when they are created.
_MODULES = ("sb3_offline.", "stable_baselines3.", "sb3_contrib.", "gymnasium.spaces.", "torch.nn.modules.", "torch.optim.")
_KINDS = (
    spaces.Space,
    th.nn.Module,
    th.optim.Optimizer,
    BaseBuffer,
    ActionNoise,
    ConstantSchedule,
    FloatSchedule,
    LinearSchedule,
    enum.Enum,
    tuple,
)


#: Attribute by which a class of this package declares that it holds values only, and runs nothing when it is created
HOLDS_VALUES = "_holds_values_only"


class _RefusedError(Exception):
    """A pickle calls something that is not known to be harmless."""


class _Checker(pickle.Unpickler):
    """Unpickles what is harmless, and refuses the rest before it is imported or called."""

    def find_class(self, module: str, name: str) -> Any:
        if module == "torch.storage" and name == "_load_from_bytes":
            return _load_tensor
        if name in _CALLABLES.get(module, ()):
            return super().find_class(module, name)
        if "." not in name and (module in ("numpy", "torch") or module.startswith(_MODULES)):
            found = getattr(importlib.import_module(module), name, None)
            if module == "numpy":
                harmless = isinstance(found, type) and issubclass(found, np.generic)
            elif module == "torch":
                harmless = isinstance(found, th.dtype)
            else:
                harmless = isinstance(found, type) and (issubclass(found, _KINDS) or HOLDS_VALUES in vars(found))
            if harmless:
                return found
        raise _RefusedError(f"it calls {module}.{name}")


def _load_tensor(data: bytes) -> Any:
    return th.load(io.BytesIO(data), weights_only=True)


def check_pickle(file: IO[bytes], path: Path, field: str, remedy: str) -> None:
    """
    Check that a pickle runs no code but that of known libraries which builds values.

    :param file: the pickle, open for reading
    :param path: its file, for the error message
    :param field: the part of the file, for the error message
    :param remedy: how to give consent, for the error message
    :raises DatasetError: if it may run other code, or if it is damaged
    """
    try:
        _Checker(file).load()
    except _RefusedError as error:
        problem = f"is a pickle, which may run any code when it is opened ({error})"
        raise DatasetError(path, field, problem, remedy) from error
    except Exception as error:  # damaged pickles raise errors of any type
        problem = f"cannot be unpickled ({' '.join(str(error).split())})"
        raise DatasetError(path, field, problem, "Save it again, with the packages that read it") from error


def check_model(path: Path, remedy: str) -> None:
    """
    Check the pickles in a saved model of Stable-Baselines3. Its tensors are no pickles that run code.

    :param path: the zip file
    :param remedy: how to give consent, for the error message
    :raises DatasetError: if the file is damaged, or if it may run code
    """
    try:
        with zipfile.ZipFile(path) as archive:
            data = json.loads(archive.read("data"))
            entries = {name: value[":serialized:"] for name, value in data.items() if _is_serialized(value)}
            pickles = {name: base64.b64decode(value) for name, value in entries.items()}
    except (OSError, EOFError, KeyError, ValueError, TypeError, AttributeError, zipfile.BadZipFile) as error:
        remedy = "Give the model.zip of a training run that has ended"
        raise DatasetError(path, "file", f"is no saved model ({' '.join(str(error).split())})", remedy) from error
    for name, pickled in pickles.items():
        check_pickle(io.BytesIO(pickled), path, name, remedy)


def _is_serialized(value: Any) -> bool:
    return isinstance(value, dict) and ":serialized:" in value
