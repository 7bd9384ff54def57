"""Refusals of the estimators, and their messages."""

import numpy as np
import pytest

from ctid_cli.errors import DataError
from ctid_cli.estimation.common import Start
from ctid_cli.estimators.srivc import Srivc
from ctid_cli.estimators.svf import Svf
from ctid_cli.estimators.td_srivc import TdSrivc
from ctid_cli.estimators.useful_redundancy import UsefulRedundancy
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record
from tests.estimators.records import make_record

TD = {"delay_bounds": (0, 2)}
ESTIMATORS = [(Svf, {}), (Srivc, {}), (TdSrivc, TD), (UsefulRedundancy, TD)]
NAMES = ["svf", "srivc", "td_srivc", "useful_redundancy"]


@pytest.mark.parametrize(("estimator", "more"), ESTIMATORS, ids=NAMES)
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"poles": 13}, "poles must be .*1 .*12.*13"),
        ({"zeros": 0.5}, "zeros must be .*0.5"),
        ({"zeros": 2}, r"fewer than poles \(a strictly proper model\): got 2 zeros and 2 poles"),
        ({"svf_cutoff": 0.0}, r"svf_cutoff must be a positive number \[rad/s\], not 0.0"),
        ({"svf_cutoff": np.nan}, "svf_cutoff must be a positive number"),
        ({"hold_output": "linear"}, "hold_output must be .*'foh'.* not 'linear'"),
    ],
)
def test_impossible_options_are_refused(estimator, more, options, message):
    with pytest.raises(ValueError, match=message):
        estimator(**{"poles": 2, "zeros": 0, **more, **options})


@pytest.mark.parametrize(("estimator", "more"), ESTIMATORS[1:], ids=NAMES[1:])
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_iterations": 2.5}, "max_iterations must be .*2.5"),
        ({"tolerance": 1.0}, "tolerance must lie between 0 and 1, not 1.0"),
        ({"tolerance": np.nan}, "tolerance must lie between 0 and 1, not nan"),
        ({"variant": "guardd"}, r"variant must be .*'guarded'.*'guardd'"),
    ],
)
def test_impossible_iterations_are_refused(estimator, more, options, message):
    with pytest.raises(ValueError, match=message):
        estimator(2, 0, **more, **options)


@pytest.mark.parametrize("bounds", [(2, 2), (-1, 2), (0, np.inf), (np.nan, 2), (0, 1, 2), 3.0])
@pytest.mark.parametrize("estimator", [TdSrivc, UsefulRedundancy])
def test_impossible_delay_bounds_are_refused(estimator, bounds):
    with pytest.raises(ValueError, match="delay_bounds must be two delays in seconds"):
        estimator(2, 0, bounds)


def record_of(t, u, y):
    return Record(np.array(t), np.array(y), HeldSignal(np.array(t), np.array(u)), name="motor.csv")


T = 0.1 * np.arange(100)
U, Y = np.sin(3 * T), np.cos(T)


@pytest.mark.parametrize(("estimator", "more"), ESTIMATORS, ids=NAMES)
@pytest.mark.parametrize(
    ("record", "message"),
    [
        (record_of(T, np.full(100, 2.5), Y), r"motor.csv: the input is constant \(2.5\)"),
        (record_of(T, U, np.full(100, 7.0)), r"motor.csv: the output is constant \(7\) over the usable samples"),
        (
            record_of(T, U, np.where(T < 9.8, np.nan, Y)),
            r"motor.csv: \d usable samples are too few for \d parameters.*longer record, a smaller model, or",
        ),
    ],
    ids=["constant input", "constant output", "too few samples"],
)
def test_records_that_tell_nothing_are_refused(estimator, more, record, message):
    with pytest.raises(DataError, match=message):
        estimator(2, 0, **more).fit(record)


@pytest.mark.parametrize("estimator", [TdSrivc, UsefulRedundancy])
def test_delay_bounds_beyond_the_record_are_refused(estimator):
    with pytest.raises(DataError, match=r"motor.csv: the greatest delay, 15 s, is not shorter than the record, 9.9 s"):
        estimator(2, 0, (0, 15)).fit(record_of(T, U, Y))
    with pytest.raises(DataError, match=r"usable samples are too few for 4 parameters"):
        estimator(2, 0, (0, 9.7)).fit(record_of(T, U, Y))


@pytest.mark.parametrize("estimator", [TdSrivc(2, 0, (2, 12)), UsefulRedundancy(2, 0, (2, 12), bandwidth=2.02)])
@pytest.mark.parametrize("delay", [1.0, 13.0, -2.0, np.nan])
def test_starts_outside_the_bounds_are_refused(estimator, delay):
    with pytest.raises(DataError, match=f"initial delay, {delay:g} s, lies outside the delay bounds, 2 to 12 s"):
        estimator.fit(make_record(n=1000), Start(delay))
