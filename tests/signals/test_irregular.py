"""Irregular clocks: the distributions of their intervals, and samples that an output sends."""

import numpy as np
import pytest
from scipy.stats import kstest

from ctid_cli.errors import DataError
from ctid_cli.kinds import classes
from ctid_cli.signals.irregular import IrregularSampling, JitteredSampling, MissingSamples, PoissonSampling
from ctid_cli.signals.sampling import RegularSampling, UniformIntervals
from ctid_cli.signals.send_on_delta import SendOnDelta
from ctid_cli.signals.streams import stream

#: Below this p-value a distribution is another one; the seeds are fixed.
LEVEL = 1e-3


def rng(replicate=0):
    return stream(5, "sampling", replicate)


SCHEMES = [
    IrregularSampling(0.1, 300),
    JitteredSampling(0.1, 300, 0.04),
    MissingSamples(0.1, 300, 0.3),
    MissingSamples(0.1, 300, 0.3, mean_burst=5.0),
    PoissonSampling(0.1, 300, dead_time=0.01),
    UniformIntervals(0.05, 0.15, 300),
]


@pytest.mark.parametrize("scheme", SCHEMES, ids=lambda scheme: scheme.kind)
def test_every_clock_starts_at_zero_repeats_and_has_its_mean(scheme):
    times = scheme.times(rng())
    assert (times.size, times[0]) == (300, 0.0)
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


def test_irregular_is_uniform_intervals_by_its_mean():
    np.testing.assert_allclose(
        IrregularSampling(0.1, 50, spread=0.2).times(rng()), UniformIntervals(0.08, 0.12, 50).times(rng()), rtol=1e-12
    )


def test_jitter_is_uniform_around_the_clock_and_does_not_add_up():
    shifts = JitteredSampling(0.1, 20_001, 0.03).times(rng())[1:] - RegularSampling(0.1, 20_001).times(rng())[1:]
    assert kstest(shifts, "uniform", (-0.03, 0.06)).pvalue > LEVEL


def test_poisson_intervals_are_exponential():
    intervals = np.diff(PoissonSampling(0.2, 20_001, dead_time=0.05).times(rng()))
    assert kstest(intervals, "expon", (0.05, 0.15)).pvalue > LEVEL


@pytest.mark.parametrize("burst", [None, 1.0, 4.0])
def test_losses_have_their_share_and_their_bursts(burst):
    missing, mean = 0.3, burst or 1 / 0.7
    ticks = np.rint(MissingSamples(0.1, 50_000, missing, burst).times(rng()) / 0.1).astype(int)
    lost = np.ones(ticks[-1] + 1, dtype=bool)
    lost[ticks] = False
    edges = np.diff(np.flatnonzero(np.diff(np.concatenate(([0], lost, [0])))))[::2]
    assert abs(edges.mean() - mean) <= 4 * np.sqrt(mean * (mean - 1) / edges.size) + 1e-12
    # The share of a renewal process: its standard error from independent stretches.
    shares = np.array([stretch.mean() for stretch in np.array_split(lost, 200)])
    assert abs(lost.mean() - missing) < 4 * shares.std() / np.sqrt(200)
    if burst is None:
        # Independent losses: the state does not depend on the one before.
        assert abs(lost[1:][lost[:-1]].mean() - missing) < 4 * np.sqrt(0.21 / lost.sum())


def test_an_output_that_moves_by_delta_is_sent():
    scheme = SendOnDelta(0.1, 12, delta=1.0, longest_interval=0.4)
    output = np.array([0.0, 0.5, 0.99, 1.0, 1.9, 0.0, 0.1, 0.2, 0.3, 0.4, 0.5, -0.5])
    # One up, one down, nothing for 0.4 s, and one more step from what was sent last.
    assert scheme.sent(output).tolist() == [0, 3, 5, 9]
    assert SendOnDelta(0.1, 12, delta=1.0).sent(output).tolist() == [0, 3, 5]
    sent = SendOnDelta(0.1, 5000, delta=0.3).sent(np.cumsum(rng().uniform(-0.05, 0.05, 5000)))
    assert sent.size > 20
    with pytest.raises(DataError, match=r"no sample is sent but the first: the output moves by 2\.4 in all"):
        SendOnDelta(0.1, 12, delta=5.0).sent(output)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: IrregularSampling(0.0, 9), r"interval must be a positive number \[s\]"),
        (lambda: IrregularSampling(0.1, 9, spread=1.0), r"spread must be a number above 0 and below 1 \[-\], not 1.0"),
        (lambda: IrregularSampling(0.1, 9, input_record="known"), "input_record must be 'sampled' or 'exact'"),
        (lambda: JitteredSampling(0.1, 9, 0.05), r"largest_shift must be less than half the interval, 0\.05 s"),
        (lambda: MissingSamples(0.1, 9, 1.0), "missing must be a number above 0 and below 1"),
        (
            lambda: MissingSamples(0.1, 9, 0.9, 3.0),
            r"mean_burst must be from 9 to 1e\+06 \[samples\] where",
        ),
        (lambda: PoissonSampling(0.1, 9, 0.1), "dead_time must be below the mean interval, 0.1 s"),
        (lambda: SendOnDelta(0.1, 9, 0.0), r"delta must be a positive number \[output unit\]"),
        (lambda: SendOnDelta(0.1, 9, 1.0, 0.05), "longest_interval is shorter than the interval of the looks, 0.1 s"),
    ],
)
def test_impossible_options_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
