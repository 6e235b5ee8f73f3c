"""Settings of this process that make learning faster and change none of its results."""

import ctypes
import functools

import torch as th

# glibc's names for its options; see mallopt(3).
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
_LARGEST_MMAP_THRESHOLD = 32 << 20


@functools.lru_cache(maxsize=1)
def prepare_process() -> None:
    """
    Flush denormal numbers, which saturated classifiers make and CPUs are many times slower on; and have glibc keep the memory
    of the last step for the next one. It would give it back and be handed zeroed pages again: a third of a step on states.
    """
    th.set_flush_denormal(True)
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError, TypeError):
        return  # not glibc
    mallopt(_M_TRIM_THRESHOLD, 2**31 - 1)
    mallopt(_M_MMAP_THRESHOLD, _LARGEST_MMAP_THRESHOLD)
