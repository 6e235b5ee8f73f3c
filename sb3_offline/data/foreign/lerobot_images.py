"""The images of LeRobot datasets, decoded when they are read: frames of videos, and encoded images in tables."""

import io
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sb3_offline.data.errors import DatasetError

CONVERT = 'sb3-offline convert {path} data.h5, or sb3_offline.data.convert.convert(dataset, "data.h5")'


class Clip(NamedTuple):
    """
    The frames of one episode in a video file.

    :param path: the video
    :param first_row: row of the table to which the first frame belongs
    :param times: (T,) seconds from the beginning of the video to each frame, increasing
    """

    path: Path
    first_row: int
    times: np.ndarray


class DecodedImages:
    """
    Images that are decoded at each access. Slices in their order are fast, scattered rows are slow.

    :param rows: (n,) rows of the table that the images belong to
    :param shape: (height, width, channels)
    :param decode: gives the images, ``(len(rows), *shape)`` uint8, of rows of the table
    :param path: of the dataset, for messages
    """

    def __init__(self, rows: np.ndarray, shape: tuple[int, ...], decode: Callable[[np.ndarray], np.ndarray], path: Path):
        self._rows, self._decode = rows, decode
        #: the way to a file that can be memory-mapped, for messages
        self.mapping_remedy = f"Decode them once into a file that is memory-mapped: {CONVERT.format(path=path)}"
        self.shape, self.dtype = (len(rows), *shape), np.dtype(np.uint8)

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, rows: Any) -> np.ndarray:
        """
        :param rows: an index, a slice, or an array of indices
        :return: the images of these rows
        """
        wanted = self._rows[rows]
        unique, inverse = np.unique(wanted, return_inverse=True)
        images = self._decode(unique) if len(unique) else np.empty((0, *self.shape[1:]), self.dtype)
        return images[inverse.reshape(np.shape(wanted))]

    def take(self, rows: np.ndarray, axis: int = 0) -> np.ndarray:
        """
        :param rows: (B,) indices of rows
        :param axis: must be 0
        :return: the images of these rows
        """
        return self[rows]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return self[:].astype(dtype or self.dtype, copy=False)


class VideoDecoder:
    """
    Frames of one camera, by rows of the table. The video that was read last stays open, so that the next rows need no seek.

    :param clips: the frames of all episodes, in the order of their rows
    :param shape: (height, width, channels) of the frames
    :param tolerance: largest difference between the time of a row and that of its frame, in seconds
    :param key: name of the camera, for messages
    """

    def __init__(self, clips: Sequence[Clip], shape: tuple[int, ...], tolerance: float, key: str):
        self._clips, self._shape, self._tolerance, self._key = clips, shape, tolerance, key
        self._first_rows = np.array([clip.first_row for clip in clips])
        self._video: _Video | None = None

    def __call__(self, rows: np.ndarray) -> np.ndarray:
        """
        :param rows: (B,) rows, increasing
        :return: ``(B, *shape)`` uint8
        :raises DatasetError: if a video is damaged, too short, or of another size, or if a row has no frame at its time
        """
        images = np.empty((len(rows), *self._shape), np.uint8)
        owners = np.searchsorted(self._first_rows, rows, side="right") - 1
        for owner in np.unique(owners):
            clip, here = self._clips[owner], np.flatnonzero(owners == owner)
            times = clip.times[rows[here] - clip.first_row]
            if self._video is None or self._video.path != clip.path:
                if self._video is not None:
                    self._video.close()
                self._video = _Video(clip.path, self._key, gray=self._shape[-1] == 1)
            for index, frame in zip(here, self._video.frames(times, self._tolerance), strict=True):
                if frame.shape != self._shape:
                    problem = f"has frames of shape {frame.shape}, but info.json declares {self._shape}"
                    raise DatasetError(clip.path, self._key, problem, "Correct the shape in meta/info.json")
                images[index] = frame
        return images


class _Video:
    """An open video file."""

    def __init__(self, path: Path, key: str, gray: bool):
        import av

        self.path, self._key, self._format = path, key, "gray" if gray else "rgb24"
        self._errors = (av.error.FFmpegError, OSError, ValueError)
        try:
            with av.open(str(path)) as container:
                stream = container.streams.video[0]
                self._pts = np.array(sorted(packet.pts for packet in container.demux(stream) if packet.pts is not None))
                self._seconds = self._pts * float(stream.time_base or 0)
            self._container = av.open(str(path))
        except (*self._errors, IndexError) as error:
            raise self._damaged(error) from error
        if not len(self._pts):
            raise self._damaged("it holds no frame")
        self._stream = self._container.streams.video[0]
        self._stream.thread_type = "AUTO"
        self._frames: Iterator[Any] = iter(())
        self._next_pts: int | None = None

    def close(self) -> None:
        self._container.close()

    def _damaged(self, error: Any) -> DatasetError:
        return DatasetError(self.path, self._key, f"cannot be decoded ({error})", "Download the video again")

    def frames(self, times: np.ndarray, tolerance: float) -> Iterator[np.ndarray]:
        """:return: the frames at these times, which increase"""
        after = np.searchsorted(self._seconds, times).clip(1, max(len(self._seconds) - 1, 1))
        after = after.clip(max=len(self._seconds) - 1)
        before = (after - 1).clip(0)
        nearest = np.where(times - self._seconds[before] <= self._seconds[after] - times, before, after)
        away = np.abs(self._seconds[nearest] - times)
        if away.max() > tolerance:
            worst = int(away.argmax())
            problem = f"has no frame at {times[worst]:.3f} s, where a row of the table asks for one ({len(self._pts)} frames"
            problem += f" from {self._seconds[0]:.3f} to {self._seconds[-1]:.3f} s)"
            remedy = "Download the video again if it is cut off; otherwise repair the timestamps of the table"
            raise DatasetError(self.path, self._key, problem, remedy)
        frame = None
        for pts in self._pts[nearest].tolist():
            if frame is None or frame.pts != pts:
                frame = self._frame_at(pts)
            yield frame.to_ndarray(format=self._format).reshape(frame.height, frame.width, -1)

    def _frame_at(self, pts: int) -> Any:
        try:
            is_near = self._next_pts is not None and self._next_pts <= pts
            if not is_near:
                self._container.seek(pts, stream=self._stream)
                self._frames = self._container.decode(self._stream)
            for frame in self._frames:
                self._next_pts = None if frame.pts is None else frame.pts + 1
                if frame.pts is not None and frame.pts >= pts:
                    return frame
        except self._errors as error:
            raise self._damaged(error) from error
        raise self._damaged("it ends too early")


def decode_encoded(images: Any, shape: tuple[int, ...], root: Path, key: str) -> Callable[[np.ndarray], np.ndarray]:
    """
    :param images: a column of a table with a struct of ``bytes`` and ``path`` in each row
    :param shape: (height, width, channels)
    :param root: folder that paths are relative to
    :param key: name of the camera, for messages
    :return: decodes rows of the column, ``(B, *shape)`` uint8
    """
    from PIL import Image, UnidentifiedImageError

    def decode(rows: np.ndarray) -> np.ndarray:
        out = np.empty((len(rows), *shape), np.uint8)
        for index, row in enumerate(rows.tolist()):
            value = images[row].as_py() or {}
            content, path = value.get("bytes"), value.get("path")
            try:
                with Image.open(io.BytesIO(content) if content else root / (path or "")) as image:
                    pixels = np.asarray(image.convert("L" if shape[-1] == 1 else "RGB"))
            except (OSError, UnidentifiedImageError) as error:
                remedy = "Download the dataset again"
                raise DatasetError(root, f"{key}, row {row}", f"cannot be decoded ({error})", remedy) from error
            if pixels.reshape(*pixels.shape[:2], -1).shape != shape:
                problem = f"is an image of {pixels.shape}, but info.json declares {shape}"
                raise DatasetError(root, f"{key}, row {row}", problem, "Correct the shape in meta/info.json")
            out[index] = pixels.reshape(shape)
        return out

    return decode


def warn_if_large(n_bytes: int, path: Path, limit: int = 1 << 30) -> None:
    """
    :param n_bytes: size of the decoded images
    :param path: of the dataset
    :param limit: size up to which no warning is given
    """
    if n_bytes > limit:
        warnings.warn(
            f"{path}: images: take {n_bytes / 2**30:.1f} GiB when they are decoded, and are decoded anew each time that the "
            f"dataset is opened to learn from. Decode them once: {CONVERT.format(path=path)}."
        )
