"""Settings of the process that make learning faster."""

import ctypes
import functools

import torch as th

# glibc's names for its options; see mallopt(3).
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
_LARGEST_MMAP_THRESHOLD = 32 << 20


@functools.lru_cache(maxsize=1)
def prepare_process() -> None:
    """
    Make learning in this process faster, once. The settings hold until the process ends, and for all of its computations.

    PyTorch treats denormal numbers as zero. Saturated classifiers produce them, and CPUs are many times slower on them.

    glibc keeps freed memory for the next step. Otherwise it returns the memory to the system, which hands out zeroed pages
    in the next step; learning from states spends a third of its time on that.
    """
    th.set_flush_denormal(True)
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError, TypeError):
        return  # The C library is not glibc.
    mallopt(_M_TRIM_THRESHOLD, 2**31 - 1)
    mallopt(_M_MMAP_THRESHOLD, _LARGEST_MMAP_THRESHOLD)
