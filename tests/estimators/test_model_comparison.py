"""Models on the same samples of one record."""

import numpy as np

from ctid_cli import DelayProfile, Record, compare, identify
from tests.cli.records import rows


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
