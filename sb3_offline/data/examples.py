"""Success examples, the observations of a solved task: read from files, folders and arrays, and written to files."""

import json
import os
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from gymnasium import spaces

from sb3_offline.data.errors import DAMAGE_ERRORS, DatasetError, damaged_file
from sb3_offline.data.files import WriteLock, open_hdf5, replacing
from sb3_offline.data.plain import check_all_plain, check_stored, is_text, read_attribute
from sb3_offline.data.spaces import check_observations, space_to_json, subspace, to_array

EXAMPLES_FORMAT = "sb3-offline-examples"
EXAMPLES_VERSION = 1
ARRAY_CRC = "crc"  # attribute of each array: its CRC-32
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
# Pillow's modes with 8 bits per channel. It would clip images of other modes (16-bit PNGs) to white
EIGHT_BIT_MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "CMYK", "YCbCr")

Observations = np.ndarray | dict[str, np.ndarray]
#: Whatever is accepted where success examples are asked for
ExamplesLike = str | os.PathLike | np.ndarray | Mapping[str, Any]


def load_examples(examples: ExamplesLike, observation_space: spaces.Space, keys: Sequence[str] | None = None) -> Observations:
    """
    Read success examples as observations of a space.

    For a Dict space, examples may show success by some of its keys only: as a dict or an ``.npz`` or HDF5 file with an array
    for each of these keys; as a dict whose values are paths, such as a folder of images for each key; or as one folder or
    array, where it is clear which key it belongs to: images to the only key of images, any array to the only key of its shape.

    :param examples: an array or a dict of arrays, or the path of one of these: a file of ``save_examples``; an ``.npz``
        file with ``observations`` or a single array (for a Dict space, with an array for each key); a ``.npy`` file; a folder
        of PNG or JPEG images. Images are taken in the order of their names, and each is resized as a whole: crop images of
        other proportions first
    :param observation_space: a Box or a Dict. Images may be channel-last or channel-first, both here and in the examples
    :param keys: the keys of a Dict space to read; the examples may hold others beside them (default: those that the examples
        hold)
    :return: ``(n, *shape)`` of the space's dtype, or a dict of such arrays
    :raises DatasetError: if there is no example, if shape, dtype or range do not fit the space, if a key is missing, or if it
        is not clear which key an array belongs to
    """
    file: str | os.PathLike = Path(examples).expanduser() if isinstance(examples, str | os.PathLike) else ""
    value: Any
    if isinstance(observation_space, spaces.Dict):
        value = _by_key(examples, file, observation_space, keys)
        observation_space = subspace(observation_space, list(value))
    else:
        value = _read(examples, file, observation_space)
        if not isinstance(value, Mapping):
            value = _match_layout(to_array(value, file, "examples"), observation_space)
    arrays = check_observations(value, observation_space, None, file, "examples")
    n = len(next(iter(arrays.values())))
    for name, array in arrays.items():
        if len(array) != n:
            problem = f"holds {len(array)} examples, but other keys hold {n}"
            raise DatasetError(file, name, problem, "Give the same number for each key")
        if n == 0:
            raise DatasetError(file, name, "holds no example", "Give at least one observation of the solved task")
        if array.dtype == np.uint8 and array.ndim == 4 and array.max() <= 1:
            remedy = "Multiply them by 255 before casting to uint8"
            raise DatasetError(file, name, "holds only the values 0 and 1", remedy)
    if isinstance(observation_space, spaces.Dict):
        held = list(observation_space.spaces)
        if missing := [key for key in keys or [] if key not in held]:
            problem = f"hold {held} and lack {missing}, by which the learner knows success"
            remedy = "Give an array for each key, or make a model that knows success by these: example_keys=[...]"
            raise DatasetError(file, "examples", problem, remedy)
        return {name.removeprefix("examples/"): array for name, array in arrays.items()}
    return arrays["examples"]


def example_columns(examples: Observations) -> dict[str, np.ndarray]:
    """
    :param examples: examples as :func:`load_examples` returns them
    :return: the examples by key ("" without a dict); those of a discrete space become columns, as in a buffer
    """
    arrays = examples if isinstance(examples, dict) else {"": examples}
    return {key: array[:, None] if array.ndim == 1 else array for key, array in arrays.items()}


def examples_checksum(examples: Observations) -> int:
    """
    :param examples: examples as :func:`load_examples` returns them
    :return: a checksum, an identifier of the examples
    """
    checksum = 0
    for array in examples.values() if isinstance(examples, dict) else [examples]:
        checksum = zlib.crc32(array.tobytes(), checksum)
    return checksum


def _read(examples: Any, file: str | os.PathLike, space: spaces.Space) -> Any:
    """:return: the examples in their own form: an array, or a dict of arrays or of more paths"""
    if not isinstance(file, Path):
        return examples
    if file.is_dir():
        return _read_images(file, space)
    return _read_numpy(file, space) if file.suffix in (".npz", ".npy") else _read_hdf5(file)


def _by_key(examples: Any, file: str | os.PathLike, space: spaces.Dict, keys: Sequence[str] | None) -> dict[str, np.ndarray]:
    """:return: the examples by key, in the order of the space"""
    parts = space.spaces if keys is None else subspace(space, keys).spaces
    value: Any
    if isinstance(file, Path) and file.is_dir():
        key = _only_key([key for key, part in parts.items() if _takes_images(part)], file, "images", parts)
        value = {key: _read_images(file, space[key])}
    else:
        value = _read(examples, file, space)
    if isinstance(value, Mapping) and not value.keys() & space.spaces.keys() and len(value) == 1:
        (value,) = value.values()  # one array, under a name of its own
    if not isinstance(value, Mapping):
        array = to_array(value, file, "examples")
        fitting = [key for key, part in parts.items() if _match_layout(array, part).shape[1:] == tuple(part.shape or ())]
        value = {_only_key(fitting, file, f"one array of shape {array.shape}", parts): array}
    if unknown := sorted(map(str, value.keys() - space.spaces.keys())):
        problem = f"are {sorted(map(str, value))}, but the observation space has no {unknown}"
        raise DatasetError(file, "examples", problem, f"Name the arrays as the space does: {list(space.spaces)}")
    return {key: _part(value[key], file, key, part) for key, part in parts.items() if key in value}


def _part(value: Any, file: str | os.PathLike, key: str, space: spaces.Space) -> np.ndarray:
    """:return: the examples of one key, which may be in a file of their own"""
    if isinstance(value, str | os.PathLike):
        return np.asarray(load_examples(value, space))
    return _match_layout(to_array(value, file, f"examples/{key}"), space)


def _only_key(candidates: Sequence[str], file: str | os.PathLike, what: str, parts: Mapping[str, spaces.Space]) -> str:
    if len(candidates) == 1:
        return candidates[0]
    which = f"which {'may belong to any of ' + str(list(candidates)) if candidates else 'fit no key'} of {dict(parts)}"
    remedy = "Say which one: examples={'KEY': ...}, or example_keys=['KEY']"
    raise DatasetError(file, "examples", f"hold {what}, {which}", remedy)


def _takes_images(space: spaces.Space) -> bool:
    return isinstance(space, spaces.Box) and space.dtype == np.uint8 and len(space.shape) == 3


def save_examples(
    path: str | os.PathLike,
    observations: np.ndarray | Mapping[str, np.ndarray],
    observation_space: spaces.Space,
    provenance: Mapping[str, Any] | None = None,
    *,
    overwrite: bool = True,
) -> None:
    """
    Write success examples to an HDF5 file. An existing file is replaced in one step.

    :param path: the file; it may begin with ``~``
    :param observations: ``(n, *shape)``, or a dict of such arrays for a Dict space
    :param observation_space: space of one observation
    :param provenance: origin of the examples (JSON)
    :param overwrite: replace an existing file
    :raises DatasetError: if the observations do not fit the space, if the file exists and ``overwrite`` is false, or if
        another process writes it
    """
    path = Path(path).expanduser()
    arrays = check_observations(observations, observation_space, None, path)
    with WriteLock(path) as lock:
        if path.exists() and not overwrite:
            raise DatasetError(path, "file", "exists already", "Give --overwrite to replace it")
        with replacing(path, lock) as temporary:
            _write(temporary, arrays, observation_space, provenance)


def _write(
    path: Path, arrays: Mapping[str, np.ndarray], observation_space: spaces.Space, provenance: Mapping[str, Any] | None
) -> None:
    with h5py.File(path, "w", locking=False) as file:
        file.attrs["format"] = EXAMPLES_FORMAT
        file.attrs["format_version"] = EXAMPLES_VERSION
        file.attrs["observation_space"] = space_to_json(observation_space)
        file.attrs["provenance"] = json.dumps(dict(provenance or {}))
        for name, array in arrays.items():
            file.create_dataset(name, data=array).attrs[ARRAY_CRC] = np.uint32(zlib.crc32(np.ascontiguousarray(array).data))


def _read_hdf5(path: Path) -> Observations:
    with open_hdf5(path) as file:
        found, version = (read_attribute(file, name) for name in ("format", "format_version"))
        if not is_text(found, EXAMPLES_FORMAT) or not isinstance(version, np.integer) or version != EXAMPLES_VERSION:
            problem = f"is {found!r} version {version}, expected {EXAMPLES_FORMAT!r} {EXAMPLES_VERSION}"
            remedy = "Extract examples from a dataset first (sb3-offline examples), or give .npz, .npy or a folder of images"
            raise DatasetError(path, "attribute format", problem, remedy)
        try:
            check_all_plain(file, path)
            node = file.get("observations")
            if node is None:
                raise DatasetError(path, "observations", "is missing", "Write the file again with save_examples")
            if isinstance(node, h5py.Dataset):
                return _read_array(node, path)
            return {key: _read_array(array, path) for key, array in node.items()}
        except DatasetError:
            raise
        except DAMAGE_ERRORS as error:
            raise damaged_file(path, error) from error


def _read_array(array: Any, path: Path) -> np.ndarray:
    if not isinstance(array, h5py.Dataset) or not array.shape or array.dtype.kind not in "biuf":
        problem = "is not an array of numbers with a row for each example"
        raise DatasetError(path, array.name.lstrip("/"), problem, "Write the file again with save_examples")
    size = os.fstat(array.file.id.get_vfd_handle()).st_size
    row_bytes = int(np.prod(array.shape[1:], dtype=object)) * array.dtype.itemsize
    check_stored(array, array.shape[0], row_bytes, size, path)
    values = array[()]
    stored = read_attribute(array, ARRAY_CRC)
    if stored is not None and not (isinstance(stored, np.integer) and stored == zlib.crc32(np.ascontiguousarray(values).data)):
        problem = "does not match the checksum that was written with it"
        remedy = f"Copy the file again. If you changed the array yourself, delete its attribute {ARRAY_CRC}"
        raise DatasetError(path, array.name.lstrip("/"), problem, remedy)
    return values


def _read_numpy(path: Path, space: spaces.Space) -> Observations:
    try:
        loaded = np.load(path, allow_pickle=False)
        arrays = loaded if isinstance(loaded, np.ndarray) else dict(loaded)
    except FileNotFoundError as error:
        raise DatasetError(path, "file", "does not exist", "Check the path") from error
    except (OSError, EOFError, ValueError, zipfile.BadZipFile) as error:  # another format, truncated, or pickled objects
        raise DatasetError(path, "file", f"cannot be read ({error})", "Save plain arrays with numpy.savez") from error
    if isinstance(arrays, np.ndarray) or isinstance(space, spaces.Dict):
        return arrays
    if "observations" not in arrays and len(arrays) != 1:
        problem = f"holds the arrays {sorted(arrays)}, none of which is called 'observations'"
        raise DatasetError(path, "observations", problem, "Rename the array of examples, or save it alone")
    return arrays["observations"] if "observations" in arrays else next(iter(arrays.values()))


def _read_images(folder: Path, space: spaces.Space) -> np.ndarray:
    """:return: (n, height, width, channels) uint8"""
    from PIL import Image, ImageOps

    if not _takes_images(space):
        problem = f"holds images, but the observation space is {space}"
        raise DatasetError(folder, "examples", problem, "A folder of images needs a space of uint8 images")
    height, width, channels = _channels_last(tuple(space.shape or ()))  # type: ignore[arg-type]
    mode = {1: "L", 3: "RGB"}.get(channels)
    if mode is None:
        problem = f"holds single images, but an observation has {channels} channels"
        raise DatasetError(folder, "examples", problem, "Stack the frames yourself and give an array or .npz")
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES)
    if not paths:
        raise DatasetError(folder, "examples", "holds no .png, .jpg or .jpeg", "Put images of the solved task there")
    frames = np.empty((len(paths), height, width, channels), np.uint8)
    for frame, path in zip(frames, paths, strict=True):
        try:
            with Image.open(path) as image:
                if image.mode not in EIGHT_BIT_MODES:
                    problem = f"has Pillow's mode {image.mode}"
                    raise DatasetError(path, "image", problem, "Save it with 8 bits per channel")
                # The rotation of a photograph is stored in a tag. BOX averages, so that thin objects stay visible
                upright = ImageOps.exif_transpose(image).convert(mode)
                frame[:] = np.asarray(upright.resize((width, height), Image.Resampling.BOX)).reshape(frame.shape)
        except OSError as error:
            raise DatasetError(path, "image", f"cannot be read ({error})", "Save it again, or remove it") from error
    return frames


def _channels_last(shape: tuple[int, ...]) -> tuple[int, int, int]:
    """:return: (height, width, channels) of an image shape in either layout: the smaller of the outer axes is the channels"""
    first, middle, last = shape
    return (middle, last, first) if first < last else (first, middle, last)


def _match_layout(array: np.ndarray, space: spaces.Space) -> np.ndarray:
    """:return: images in the other layout if that makes them fit the space; any other array as it is"""
    shape = tuple(space.shape or ())
    if array.ndim == 4 and len(shape) == 3 and array.shape[1:] != shape:
        for axes in ((0, 3, 1, 2), (0, 2, 3, 1)):
            if array.transpose(axes).shape[1:] == shape:
                return array.transpose(axes)
    return array
