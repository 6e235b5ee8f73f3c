"""Jobs in worker processes."""

import functools
import multiprocessing
import operator
import time

import pytest

from sb3_offline.parallel.processes import run_all


def test_a_job_that_fails_ends_the_others():
    jobs = [functools.partial(time.sleep, 600), functools.partial(operator.truediv, 1, 0)]
    with pytest.raises(ZeroDivisionError):
        run_all(jobs, 2, lambda: None)
    for process in multiprocessing.active_children():
        process.join()  # for ever, unless it was terminated
