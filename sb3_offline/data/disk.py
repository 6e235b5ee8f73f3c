"""Full disks: told from other errors, and waited for."""

import errno
import shutil
import time
from pathlib import Path

from sb3_offline.data.errors import DatasetError

#: Bytes that must be free before the work goes on
ROOM = 50_000_000
SECONDS = 5.0
_FULL = (errno.ENOSPC, errno.EDQUOT) if hasattr(errno, "EDQUOT") else (errno.ENOSPC,)


def is_full_disk(error: BaseException | None, folder: Path) -> bool:
    """
    :param error: an error
    :param folder: an existing folder that was written to
    :return: whether the error came from a full disk. Some libraries raise another error then, so the disk is looked at, too
    """
    is_writing = isinstance(error, OSError | RuntimeError) and not isinstance(error, DatasetError | FileNotFoundError)
    if is_writing and free_bytes(folder) < 1_000_000:
        return True
    seen = error
    while seen is not None:
        if isinstance(seen, OSError) and seen.errno in _FULL:
            return True
        seen = seen.__cause__ or seen.__context__
    return False


def free_bytes(folder: Path) -> int:
    """
    :param folder: an existing folder
    :return: number of bytes that can be written there
    """
    return shutil.disk_usage(folder).free


def wait_for_room(folder: Path) -> None:
    """
    Say that a disk is full, and wait until it is not.

    :param folder: an existing folder on that disk
    """
    print(f"{folder}: the disk is full. Paused until {ROOM // 1_000_000} MB are free; nothing is lost", flush=True)
    while free_bytes(folder) < ROOM:
        time.sleep(SECONDS)
