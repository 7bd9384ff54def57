"""Sampling schemes: distributions of intervals, given instants, and record lengths."""

import numpy as np
import pytest
from scipy.stats import kstest

from ctid_cli.errors import DataError
from ctid_cli.kinds import classes
from ctid_cli.signals.noise import stream
from ctid_cli.signals.sampling import (
    InstantsFile,
    IrregularSampling,
    JitteredSampling,
    RegularSampling,
    UniformIntervals,
)

#: Significance level of the tests of distributions; the seeds are fixed.
LEVEL = 1e-3


def rng(replicate=0):
    return stream(5, "sampling", replicate)


@pytest.mark.parametrize(
    "scheme",
    [IrregularSampling(0.1, 300), JitteredSampling(0.1, 300, 0.04), UniformIntervals(0.05, 0.15, 300)],
    ids=lambda scheme: scheme.kind,
)
def test_every_drawn_clock_starts_at_zero_repeats_and_has_its_mean(scheme):
    times = scheme.times(rng())
    assert (times.size, times[0]) == (scheme.length, 0.0)
    assert (np.diff(times) > 0).all()
    assert np.array_equal(times, scheme.times(rng()))
    assert not np.array_equal(times, scheme.times(rng(1)))
    ends = np.array([scheme.times(rng(k))[-1] for k in range(400)]) / 299
    assert abs(ends.mean() - scheme.mean_interval) < 4 * ends.std() / 20
    # Longer records begin with the shorter ones.
    longer = type(scheme)(**vars(scheme) | {"samples": 500}).times(rng())
    np.testing.assert_allclose(longer[:300], times, atol=1e-12)


def test_irregular_clocks_tell_the_exact_input_unless_asked_for_samples():
    told = {kind: scheme.input_record for kind, scheme in classes("sampling").items()}
    assert told.pop("regular") == "sampled"
    assert set(told.values()) == {"exact"}


def test_a_regular_clock_does_not_add_up_rounding():
    assert np.array_equal(RegularSampling(0.1, 5000).times(rng()), 0.1 * np.arange(5000))


def test_intervals_are_uniform_between_their_bounds():
    intervals = np.diff(UniformIntervals(0.01, 0.09, 20_001).times(rng()))
    assert kstest(intervals, "uniform", (0.01, 0.08)).pvalue > LEVEL
    by_mean = IrregularSampling(0.1, 50, spread=0.2).times(rng())
    np.testing.assert_allclose(by_mean, UniformIntervals(0.08, 0.12, 50).times(rng()), rtol=1e-12)


def test_jitter_is_uniform_around_the_clock_and_does_not_add_up():
    shifts = JitteredSampling(0.1, 20_001, 0.03).times(rng())[1:] - RegularSampling(0.1, 20_001).times(rng())[1:]
    assert kstest(shifts, "uniform", (-0.03, 0.06)).pvalue > LEVEL


def test_instants_come_from_a_column_of_a_file(tmp_path):
    file = tmp_path / "stamps.csv"
    file.write_text("time,u\n12.5,0\n12.6,0\n13,0\n")
    scheme = InstantsFile(str(file), time="time")
    assert scheme.times(None).tolist() == [12.5, 12.6, 13.0]
    assert (scheme.length, scheme.mean_interval) == (3, 0.25)
    file.write_text("t\n0\n0.2\n0.1\n")
    with pytest.raises(DataError, match=r"stamps\.csv:4: time 't' goes back to 0\.1 s after 0\.2 s on line 3"):
        InstantsFile(str(file)).times(None)
    file.write_text("t\n0\n")
    with pytest.raises(DataError, match="there is one instant"):
        InstantsFile(str(file)).times(None)
