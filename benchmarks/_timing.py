"""Common parts of the benchmarks: one thread for linear algebra, processor time, and alternating calls.

Import it before numpy, which sets its threads when it is loaded.
"""

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import resource
import time

import numpy as np


def cpu(function, *arguments):
    """Return the processor time of a call [s], which other processes disturb least, and its result."""
    begun = time.process_time()
    result = function(*arguments)
    return time.process_time() - begun, result


def least(repeats, *calls):
    """Return the least processor time of each call [s]; they alternate, so that a disturbance affects all of them."""
    for call in calls:
        call()  # compiles, or loads the compiled function
    return np.min([[cpu(call)[0] for call in calls] for _ in range(repeats)], axis=0)


def cpu_of_children():
    """Return the processor time of all child processes that have ended [s]."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
