"""Models on the same samples of one record."""

from dataclasses import replace

import numpy as np
import pytest

from ctid_cli import DelayProfile, Record, compare, identify
from ctid_cli.estimators.loop_output_error import LoopOutputError
from tests.cli.records import rows
from tests.estimators.test_loop_output_error import PD, PI, STABLE, UNSTABLE
from tests.estimators.test_loop_output_error import record as record_in_loop


def test_models_are_compared_with_one_treatment():
    record, other = (Record.from_arrays(*rows(seed, noise=0.05, offset=0.3).T) for seed in (0, 1))
    options = DelayProfile(2, 0, (0.0, 3.0), offset="estimate")
    fits = [identify([record], options), options.fit(record, None)]
    own, plain = compare(fits, other)
    assert (own.offset, plain.offset) == ("estimate", "none")
    assert own.fit_percent > plain.fit_percent + 20
    same = compare(fits, other, offset="estimate")
    assert same[0].fit_percent == same[1].fit_percent == own.fit_percent
    from_rest, treated = compare(fits[1:], other, initial_state="rest")[0], compare(fits[1:], other, offset="remove")[0]
    assert treated.rms < from_rest.rms
    states = compare([fits[0], options.fit(record, None)], other, initial_state="estimate")
    assert (states[0].t == states[1].t).all()
    gaps = Record(other.t, np.where(other.t == 2.0, np.nan, other.y), other.input)
    assert compare(fits, gaps)[0].count == other.n_samples - 1


@pytest.mark.parametrize("state", ["rest", "estimate"])
def test_stable_plant_of_a_loop_is_compared_on_a_record_without_its_loop(state):
    fit = identify([record_in_loop(STABLE, PI, count=600)], LoopOutputError(2, 0, (0.0, 0.4), initial_state=state))
    other = replace(record_in_loop(STABLE, PI, count=600, seed=2), loop=None)
    plain = compare([DelayProfile(2, 0, (0.0, 0.4)).fit(other)], other)[0]
    assert compare([fit], other)[0].rms == pytest.approx(plain.rms, rel=0.02)


def test_unstable_plant_of_a_loop_is_compared_by_innovations_on_a_record_without_its_loop():
    fit = identify([record_in_loop(UNSTABLE, PD, noise=0.02)], LoopOutputError(2, 0, (0.0, 0.4)))
    other = replace(record_in_loop(UNSTABLE, PD, noise=0.02, seed=2), loop=None)
    assert compare([fit], other)[0].rms < 0.1
