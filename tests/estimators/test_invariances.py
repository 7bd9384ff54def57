"""Invariance of estimates to units, to the origin of time, and to missing samples."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctid_cli.estimation.common import Start
from ctid_cli.estimators.additive_srivc import AdditiveSrivc
from ctid_cli.estimators.delay_profile import DelayProfile
from ctid_cli.estimators.srivc import Srivc
from ctid_cli.estimators.svf import Svf
from ctid_cli.estimators.td_srivc import TdSrivc
from ctid_cli.estimators.useful_redundancy import UsefulRedundancy
from ctid_cli.filtering.lowpass import Lowpass
from ctid_cli.models.additive import Term
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record
from tests.estimators.records import CASE_1, CASE_2, assert_same_model, make_record

#: Estimators of the two systems with times in a unit [s], their starts [s], and their relative accuracy.
ESTIMATORS = {
    "srivc": (CASE_1, lambda s: Srivc(2, 0, 8.0 * s, 1.0 / s, tolerance=1e-11), None, 1e-8),
    "srivc, two modes": (CASE_2, lambda s: Srivc(4, 1, 8.0 * s, 25.0 / s, tolerance=1e-11), None, 1e-8),
    "td_srivc": (
        CASE_2,
        lambda s: TdSrivc(4, 1, (0.0, 9.0 * s), svf_cutoff=25.0 / s, tolerance=1e-11),
        7.9,
        1e-8,
    ),
    "useful_redundancy": (
        CASE_1,
        lambda s: UsefulRedundancy(2, 0, (0.0, 15.0 * s), bandwidth=2.02 / s, svf_cutoff=1.0 / s),
        3.0,
        1e-6,
    ),
    "delay_profile": (
        CASE_1,
        lambda s: DelayProfile(2, 0, (0.0, 9.0 * s), initial_state="estimate", offset="estimate"),
        None,
        1e-8,
    ),
    "additive_srivc": (CASE_1, lambda s: AdditiveSrivc((Term(2, 0),), delay=8.0 * s, tolerance=1e-11), None, 1e-8),
}


def record_of(name, regular):
    return make_record(ESTIMATORS[name][0], snr_db=10, regular=regular, n=1500, clock_period=0.5)


@cache
def reference(name, regular):
    return fitted(name, record_of(name, regular))


def fitted(name, record, seconds=1.0):
    _, estimator, start, _ = ESTIMATORS[name]
    return estimator(seconds).fit(record, None if start is None else Start(start * seconds))


def factor(name, model, seconds, gain, output):
    """Return the factor of a parameter under a change of units."""
    if name in ("delay", "offset"):
        return {"delay": seconds, "offset": output}[name]
    power = int(name[-1])
    if name.startswith("g"):
        return seconds**power * (gain if "b" in name else 1.0)
    return seconds**-power if name[0] == "a" else gain * seconds ** -(model.relative_degree + power)


@settings(max_examples=40)
@given(
    st.sampled_from(sorted(ESTIMATORS)),
    st.booleans(),
    st.one_of(st.sampled_from([1e6, 1e9, 1 / 60, 1 / 86_400]), st.floats(-9, 9).map(lambda x: 10**x)),
    st.floats(-1e3, 1e3),
    st.floats(-9, 9),
    st.floats(-9, 9),
    st.sampled_from([1, -1]),
)
def test_units_and_the_origin_of_time(name, regular, seconds, shift, input_decades, output_decades, sign):
    # From seconds to nanoseconds, days and units between; a clock at 1000 s has 13 digits in its intervals.
    record, one = record_of(name, regular), reference(name, regular)
    inward, output = sign * 10**input_decades, 10**output_decades
    held = HeldSignal((record.input.t + shift) * seconds, record.input.values * inward, record.input.hold)
    two = fitted(name, Record((record.t + shift) * seconds, record.y * output, held), seconds)
    tolerance = ESTIMATORS[name][3]
    for parameter, value in one.parameters.items():
        if parameter.startswith("x"):  # initial states have separate units
            continue
        scale = factor(parameter, one.model, seconds, output / inward, output)
        assert two.parameters[parameter] == pytest.approx(scale * value, rel=tolerance, abs=1e-9 * abs(scale))
        error = abs(scale) * one.standard_errors[parameter]
        assert two.standard_errors[parameter] == pytest.approx(error, rel=100 * tolerance)
    assert two.cost == pytest.approx(output**2 * one.cost, rel=1e-8)
    assert two.fit_percent == pytest.approx(one.fit_percent, rel=1e-8)
    assert one.status is two.status


@pytest.mark.parametrize(
    ("estimator", "start"),
    [(Srivc(2, 0, 8.0, 1.0), None), (TdSrivc(2, 0, (0, 15), svf_cutoff=1.0, tolerance=1e-10), Start(7.5))],
)
def test_missing_outputs_are_as_good_as_absent_ones(estimator, start):
    # A linear hold bridges a gap by the same line in both cases, so all numbers agree.
    record = make_record(snr_db=15, regular=False)
    gone = np.random.default_rng(0).random(record.n_samples) < 0.1
    with_nan = Record(record.t, np.where(gone, np.nan, record.y), record.input)
    absent = Record(record.t[~gone], record.y[~gone], record.input)
    one, two = (estimator.fit(each, start) for each in (with_nan, absent))
    assert one.count == two.count < record.n_samples
    assert_same_model(one.model, two.model, 1e-9)
    np.testing.assert_allclose(one.cost, two.cost, rtol=1e-10)
    assert one.iterations == two.iterations


@pytest.mark.parametrize(
    ("estimator", "start"),
    [
        (Svf(2, 0, 8.0, 1.0), None),
        (Srivc(2, 0, 8.0, 1.0), None),
        (TdSrivc(2, 0, (0, 15), Lowpass(0.4), 1.0), Start(7.0)),
        (UsefulRedundancy(2, 0, (0, 15), 2.02, svf_cutoff=1.0), Start(7.0)),
        (DelayProfile(2, 0, (0, 15), offset="remove"), None),
    ],
)
def test_nothing_of_the_record_changes(estimator, start):
    record = make_record(snr_db=15, n=1500)
    before = [a.copy() for a in (record.t, record.y, record.input.t, record.input.values)]
    estimator.fit(record, start)
    after = (record.t, record.y, record.input.t, record.input.values)
    assert all(np.array_equal(a, b) for a, b in zip(before, after, strict=True))
