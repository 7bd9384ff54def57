"""Compilation of the kernels of a run before its worker processes start."""

import time
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import fields, replace
from typing import Any

import numpy as np

from ctid_cli.errors import DataError
from ctid_cli.filtering.simulate import simulate
from ctid_cli.models.controller import ContinuousController, DiscreteController
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Loop, Record

#: Options that make an estimator of any kind finish quickly on the record below. All other options, which determine the
#: kernels that are called, are kept.
SHORT_WORK: dict[str, Any] = {
    "delay": 0.0,
    "delay_bounds": (0.0, 1.0),
    "bandwidth": 2.0,
    "lowpass": None,
    "filters": 2,
    "beta": 2.0,
    "max_iterations": 1,
    "max_rounds": 1,
    # The record below has one input.
    "inputs": None,
    "fixed": None,
}


def compile_kernels(estimators: Iterable[Any], *, regular: bool = True, closed: bool = False) -> float:
    """Compile the kernels of estimators for one kind of record, or load them from the disk cache; return the time [s].

    Numba stores compiled code in the package's folders, or in ``NUMBA_CACHE_DIR`` if that is set.
    """
    began = time.perf_counter()
    rng = np.random.default_rng(0)
    t = np.linspace(0.0, 49.75, 200)
    if not regular:
        t[1:] += rng.uniform(-0.1, 0.1, t.size - 1)
    held = HeldSignal(t, rng.choice([-1.0, 1.0], t.size))
    output = simulate(TransferFunction([2.0], [1.0, 2.0, 2.0], 0.4), held, t) + 0.1 * rng.standard_normal(t.size)
    gain = (DiscreteController if regular else ContinuousController)([0.1], [1.0])
    record = Record(t, output, held, loop=Loop(held.values, gain) if closed else None)
    for estimator in estimators:
        names = {item.name for item in fields(estimator)}
        # Not every structure can be estimated from this record; kernels called before the error are compiled.
        with suppress(DataError):
            replace(estimator, **{name: value for name, value in SHORT_WORK.items() if name in names}).fit(record)
    return time.perf_counter() - began
