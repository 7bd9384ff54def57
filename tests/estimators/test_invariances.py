"""An estimate does not depend on the units, nor on the clock on the wall."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctid_cli.estimation.common import Start
from ctid_cli.estimators.srivc import Srivc
from ctid_cli.estimators.svf import Svf
from ctid_cli.estimators.td_srivc import TdSrivc
from ctid_cli.estimators.useful_redundancy import UsefulRedundancy
from ctid_cli.filtering.lowpass import Lowpass
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record
from tests.estimators.records import CASE_1, CASE_2, assert_same_model, make_record

RECORDS = {
    (model, regular): make_record(model, snr_db=10, regular=regular, n=1500, clock_period=0.5)
    for model in (CASE_1, CASE_2)
    for regular in (True, False)
}
CASES = st.sampled_from(list(RECORDS))
TOLERANCE = 1e-11


def moved(record, *, seconds=1.0, shift=0.0, input_scale=1.0, output_scale=1.0):
    """The same record in other units, or recorded at another time."""
    held = HeldSignal(record.input.t * seconds + shift, record.input.values * input_scale, record.input.hold)
    return Record(record.t * seconds + shift, record.y * output_scale, held)


def fit(model, record, seconds=1.0, delay=None):
    """Both estimators; cut-off, delay and bounds in the time unit of the record."""
    n, m = model.order, model.numerator.size - 1
    cutoff = {2: 1.0, 4: 25.0}[n] / seconds
    td = TdSrivc(n, m, (0.0, 9.0 * seconds), svf_cutoff=cutoff, tolerance=TOLERANCE)
    fixed = Srivc(n, m, delay=8.0 * seconds, svf_cutoff=cutoff, tolerance=TOLERANCE)
    return td.fit(record, Start(7.9 * seconds)), fixed.fit(record)


REFERENCE = {case: fit(case[0], record) for case, record in RECORDS.items()}


def assert_same(fits, reference, seconds=1.0, gain=1.0, output_scale=1.0, tolerance=1e-8):
    """Same estimates and standard errors after the change of units."""
    for one, two in zip(fits, reference, strict=True):
        n, m = two.model.order, two.model.numerator.size - 1
        factor = {f"a{i}": seconds**-i for i in range(1, n + 1)}
        factor |= {f"b{j}": gain * seconds ** -(n - m + j) for j in range(m + 1)}
        factor["delay"] = seconds
        for name, value in two.parameters.items():
            np.testing.assert_allclose(one.parameters[name], factor[name] * value, rtol=tolerance)
            np.testing.assert_allclose(
                one.standard_errors[name], abs(factor[name]) * two.standard_errors[name], rtol=100 * tolerance
            )
        np.testing.assert_allclose(one.cost, output_scale**2 * two.cost, rtol=1e-9)
        np.testing.assert_allclose(one.fit_percent, two.fit_percent, rtol=1e-8)
        assert one.status is two.status


@settings(max_examples=15)
@given(CASES, st.one_of(st.sampled_from([1e6, 1e9, 1 / 60, 1 / 86_400]), st.floats(-9, 9).map(lambda x: 10**x)))
def test_unit_of_time(case, seconds):
    # From seconds to microseconds, nanoseconds, minutes, days and anything between.
    assert_same(fit(case[0], moved(RECORDS[case], seconds=seconds), seconds), REFERENCE[case], seconds=seconds)


@settings(max_examples=15)
@given(CASES, st.floats(-12, 12), st.floats(-12, 12), st.sampled_from([1, -1]))
def test_units_of_the_signals(case, input_decades, output_decades, sign):
    input_scale, output_scale = sign * 10**input_decades, 10**output_decades
    record = moved(RECORDS[case], input_scale=input_scale, output_scale=output_scale)
    gain = output_scale / input_scale
    assert_same(fit(case[0], record), REFERENCE[case], gain=gain, output_scale=output_scale)


@settings(max_examples=15)
@given(CASES, st.floats(-1e3, 1e3))
def test_origin_of_time(case, shift):
    # A clock that reads 1000 s holds 13 digits of the intervals.
    assert_same(fit(case[0], moved(RECORDS[case], shift=shift)), REFERENCE[case])


@pytest.mark.parametrize(
    ("estimator", "start"),
    [(Srivc(2, 0, 8.0, 1.0), None), (TdSrivc(2, 0, (0, 15), svf_cutoff=1.0, tolerance=1e-10), Start(7.5))],
)
def test_missing_outputs_are_as_good_as_absent_ones(estimator, start):
    # A linear hold bridges a gap by the same line either way, so every number agrees.
    record = make_record(snr_db=15, regular=False)
    gone = np.zeros(record.n_samples, bool)
    gone[np.random.default_rng(0).choice(record.n_samples, 400, replace=False)] = True
    with_nan = Record(record.t, np.where(gone, np.nan, record.y), record.input)
    absent = Record(record.t[~gone], record.y[~gone], record.input)
    one, two = (estimator.fit(each, start) for each in (with_nan, absent))
    assert one.count == two.count < record.n_samples
    assert_same_model(one.model, two.model, 1e-9 if start else 1e-10)
    np.testing.assert_allclose(one.cost, two.cost, rtol=1e-10)
    assert one.iterations == two.iterations


@pytest.mark.parametrize(
    ("estimator", "start"),
    [
        (Svf(2, 0, 8.0, 1.0), None),
        (Srivc(2, 0, 8.0, 1.0), None),
        (TdSrivc(2, 0, (0, 15), Lowpass(0.4), 1.0), Start(7.0)),
        (UsefulRedundancy(2, 0, (0, 15), 2.02, svf_cutoff=1.0), Start(7.0)),
    ],
)
def test_nothing_of_the_record_changes(estimator, start):
    record = make_record(snr_db=15, n=1500)
    before = [a.copy() for a in (record.t, record.y, record.input.t, record.input.values)]
    estimator.fit(record, start)
    after = (record.t, record.y, record.input.t, record.input.values)
    assert all(np.array_equal(a, b) for a, b in zip(before, after, strict=True))
