"""Report of a fit, and its quality measures."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctid_cli.estimators.additive_srivc import AdditiveFit
from ctid_cli.estimators.measured_fit import MeasuredFit
from ctid_cli.estimators.useful_redundancy import RedundantFit
from ctid_cli.frequency.base import FrequencyTrack
from ctid_cli.inference.criteria import fit_percent, r_squared
from ctid_cli.inference.fit import Fit, Status
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record

VALUES = st.lists(st.floats(-100, 100), min_size=3, max_size=20).filter(lambda v: np.ptp(v) > 1e-3)


def make_fit(model, names, covariance=None):
    covariance = np.diag(np.arange(1.0, len(names) + 1) ** 2) if covariance is None else covariance
    return Fit(model, names, covariance, Status.CONVERGED, 0.1, 90.0, 0.99, 100, 3, 12.0)


def test_parameters_and_standard_errors_go_by_name():
    fit = make_fit(TransferFunction([5.0, 6.0], [1.0, 2.0, 3.0], 0.5), ("a1", "a2", "b0", "b1", "delay"))
    assert fit.parameters == {"a1": 2.0, "a2": 3.0, "b0": 5.0, "b1": 6.0, "delay": 0.5}
    assert fit.standard_errors == {"a1": 1.0, "a2": 2.0, "b0": 3.0, "b1": 4.0, "delay": 5.0}


def test_results_and_data_are_short_to_read():
    fit = make_fit(TransferFunction([5.0, 6.0], [1.0, 2.0, 3.0], 0.5), ("a1", "a2", "b0", "b1", "delay"))
    assert repr(fit) == (
        "Fit: CONVERGED, fit 90 % of 100 samples\n  a1 = 2 ± 1, a2 = 3 ± 2, b0 = 5 ± 3, b1 = 6 ± 4, delay = 0.5 ± 5"
    )
    long = make_fit(TransferFunction([1.0], np.arange(1.0, 14.0)), (*(f"a{k}" for k in range(1, 13)), "b0"))
    assert max(map(len, repr(long).splitlines())) <= 100
    assert all(kind.__repr__ is Fit.__repr__ for kind in (AdditiveFit, MeasuredFit, RedundantFit))
    t = 0.1 * np.arange(1000)
    record = Record(t, np.where(t == 0, np.nan, t), HeldSignal(t, t, "foh"), name="dryer.csv")
    assert repr(record) == "Record('dryer.csv', 1000 samples from 0 to 99.9 s, every 0.1 s, 1 missing)"
    assert repr(record.input) == "HeldSignal(1000 values from 0 to 99.9 s, foh)"
    track = FrequencyTrack(t, np.ones((1000, 2)), (t < 25).astype(np.uint16))
    assert repr(track) == "FrequencyTrack(1000 rows of 2 frequencies, 0.75 of them valid)"


def test_coefficient_that_vanished_keeps_its_name():
    fit = make_fit(TransferFunction([0.0, 6.0], [1.0, 2.0, 3.0]), ("a1", "a2", "b0", "b1"))
    assert fit.parameters == {"a1": 2.0, "a2": 3.0, "b0": 0.0, "b1": 6.0}


@given(VALUES, st.integers(0, 2**31))
def test_measures_of_fit_follow_their_definitions(y, seed):
    y = np.array(y)
    x = y + np.random.default_rng(seed).standard_normal(y.size)
    ratio = np.linalg.norm(y - x) / np.linalg.norm(y - y.mean())
    assert fit_percent(y, x) == pytest.approx(100 * (1 - ratio), rel=1e-9, abs=1e-9)
    assert r_squared(y, x) == pytest.approx(1 - ratio**2, rel=1e-9, abs=1e-9)
    with_gap, beside = np.append(y, np.nan), np.append(x, 1e6)
    assert fit_percent(with_gap, beside) == fit_percent(y, x)


def test_constant_or_missing_output_has_no_fit():
    assert np.isnan(fit_percent([1.0, 1.0], [1.0, 2.0]))
    assert np.isnan(r_squared([np.nan, np.nan], [1.0, 2.0]))


def test_only_optimal_and_one_shot_estimates_count_as_successes():
    best = {Status.CONVERGED, Status.AT_BOUND, Status.RIDGE, Status.LEAST_SQUARES}
    assert {status for status in Status if status.succeeded} == best
    assert len({status.value for status in Status}) == len(Status)
