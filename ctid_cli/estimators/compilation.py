"""Compile every kernel once, so that no later process has to."""

from __future__ import annotations

import time

import numpy as np

from ctid_cli.estimators.problems import is_hurwitz
from ctid_cli.filtering.bank import filter_data, second_moments
from ctid_cli.filtering.simulate import simulate
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record


def compile_kernels() -> float:
    """Compile all kernels, or load them from the cache on disk.

    Returns
    -------
    float
        Seconds spent: some tens on the first call after an installation, a fraction of one later.

    Notes
    -----
    Numba keeps the compiled code beside the package, or in ``NUMBA_CACHE_DIR`` if that is set.
    """
    began = time.perf_counter()
    t = np.arange(8.0)
    signal = HeldSignal(t, np.array([0.0, 1.0] * 4))
    a, b = np.array([1.0, 2.0, 4.0]), np.array([1.0])
    simulate(TransferFunction(b, a), signal, t)
    second_moments(filter_data(Record(t, t, signal)), a, b)
    is_hurwitz(a)
    return time.perf_counter() - began
