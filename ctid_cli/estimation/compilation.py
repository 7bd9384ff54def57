"""Compile every kernel once, so that no later process has to."""

from __future__ import annotations

import time
from collections.abc import Iterable
from typing import Any

import numpy as np

from ctid_cli.estimation.compiled_iteration import best_coefficients
from ctid_cli.estimation.problems import is_hurwitz
from ctid_cli.estimation.spectral_problem import SpectralCoefficientProblem
from ctid_cli.filtering.bank import second_moments
from ctid_cli.filtering.filter_data import filter_data
from ctid_cli.filtering.loop import simulate_loop
from ctid_cli.filtering.simulate import simulate
from ctid_cli.filtering.spectra import record_spectra
from ctid_cli.filtering.submodels import SubmodelFilter
from ctid_cli.inference.sensitivity import Structure
from ctid_cli.models.additive import Term
from ctid_cli.models.controller import DiscreteController
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record


def compile_kernels(estimators: Iterable[Any] = ()) -> float:
    """Compile the kernels that every estimator needs, or load them from the cache on disk.

    Numba keeps the compiled code beside the package, or in ``NUMBA_CACHE_DIR`` if that is set.
    """
    began = time.perf_counter()
    t = np.arange(8.0)
    signal = HeldSignal(t, np.array([0.0, 1.0] * 4))
    a, b = np.array([1.0, 2.0, 4.0]), np.array([1.0])
    simulate(TransferFunction(b, a), signal, t)
    record = Record(t, t, signal)
    second_moments(filter_data(record), a, b)
    is_hurwitz(a)
    estimators = list(estimators)
    if any(estimator.kind == "additive_srivc" or _in_loop(estimator) for estimator in estimators):
        SubmodelFilter(filter_data(record), (Term(1, 0),)).moments(np.array([1.0, 1.0]))
    if any(_in_loop(estimator) for estimator in estimators):
        controller = DiscreteController([1.0], [1.0])
        simulate_loop(TransferFunction(b, a), controller, np.ones(8), np.zeros(8), 1.0)
    searches = {getattr(estimator, "search", None) for estimator in estimators}
    if searches & {"time", "spectral"}:
        best_coefficients(
            filter_data(record),
            Structure(2, 0),
            0.0,
            np.array([[2.0, 4.0, 1.0]]),
            max_iterations=1,
            tolerance=0.1,
            halvings=1,
        )
    if "spectral" in searches:
        spectra = record_spectra(record, 0.0, 3.0, 0.0)
        weight = np.ones(spectra.frequencies.size)
        SpectralCoefficientProblem(spectra, Structure(2, 0), 0.0, weight).equations(np.array([2.0, 4.0, 1.0]))
    return time.perf_counter() - began


def _in_loop(estimator: Any) -> bool:
    return getattr(estimator, "instruments", "open_loop") == "closed_loop"
