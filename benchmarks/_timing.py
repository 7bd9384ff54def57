"""What every benchmark shares: one thread for linear algebra, processor time, and calls that take turns.

To be imported before numpy, whose threads are counted when it is loaded.
"""

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import resource
import time

import numpy as np


def cpu(function, *arguments):
    """Processor time of a call [s], which neighbours on the same cores disturb least, and what it returns."""
    begun = time.process_time()
    result = function(*arguments)
    return time.process_time() - begun, result


def least(repeats, *calls):
    """Least processor time of each call [s]; they take turns, so that a disturbance meets all of them."""
    for call in calls:
        call()  # compiles, or loads what was compiled
    return np.min([[cpu(call)[0] for call in calls] for _ in range(repeats)], axis=0)


def cpu_of_children():
    """Processor time of all processes that were started and have ended [s]."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
