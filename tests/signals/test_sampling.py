"""Sampling schemes and the random streams that drive them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctid_cli.signals.regularity import regular_interval
from ctid_cli.signals.sampling import RegularSampling, UniformIntervals, geometric_sizes
from ctid_cli.signals.streams import ROLES, stream


def rng(replicate=0):
    return stream(3, "sampling", replicate)


@given(st.floats(1e-6, 1e3), st.integers(2, 5000))
def test_regular_times_are_multiples_of_the_interval(interval, samples):
    times = RegularSampling(interval, samples).times(rng())
    assert times.size == samples
    assert all(times[k] == k * interval for k in (0, 1, samples // 2, samples - 1))
    assert regular_interval(times) == pytest.approx(interval, rel=1e-12)


@given(st.floats(1e-3, 1), st.floats(1, 3), st.integers(2, 500), st.integers(0, 50))
def test_uniform_intervals_keep_their_bounds(low, ratio, samples, replicate):
    times = UniformIntervals(low, low * ratio, samples).times(rng(replicate))
    assert times.size == samples
    assert times[0] == 0.0
    rounding = 1e-12 * times[-1]
    assert np.diff(times).min() >= low - rounding
    assert np.diff(times).max() <= low * ratio + rounding


def test_uniform_intervals_are_uniform():
    intervals = np.diff(UniformIntervals(0.01, 0.09, 20_001).times(rng()))
    assert regular_interval(UniformIntervals(0.01, 0.09, 100).times(rng())) is None
    counts, _ = np.histogram(intervals, bins=20, range=(0.01, 0.09))
    # 43.8 is exceeded by a chi-square variable of 19 degrees of freedom in one case of a thousand.
    assert ((counts - 1000) ** 2 / 1000).sum() < 43.8


def test_equal_bounds_are_regular_sampling():
    np.testing.assert_allclose(
        UniformIntervals(0.5, 0.5, 200).times(rng()), RegularSampling(0.5, 200).times(rng()), rtol=1e-13
    )


def test_replicates_have_times_of_their_own():
    scheme = UniformIntervals(0.01, 0.09, 50)
    assert np.array_equal(scheme.times(rng(4)), scheme.times(rng(4)))
    assert not np.array_equal(scheme.times(rng(4)), scheme.times(rng(5)))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: RegularSampling(0.0, 10), r"interval must be a positive number \[s\], not 0.0"),
        (lambda: RegularSampling(0.1, 1), "samples must be an integer of at least 2, not 1"),
        (lambda: RegularSampling(0.1, 10.5), "samples must be an integer of at least 2, not 10.5"),
        (
            lambda: RegularSampling(0.1, 10, "guessed"),
            "input_record must be 'sampled' or 'exact', not 'guessed'",
        ),
        (lambda: UniformIntervals(0.2, 0.1, 10), "low must not exceed high; they are 0.2 s and 0.1 s"),
        (lambda: UniformIntervals(0.0, 0.1, 10), "low must be a positive number"),
        (lambda: UniformIntervals(0.1, float("inf"), 10), "high must be a positive number"),
        (lambda: UniformIntervals(0.1, 0.2, 1), "samples must be an integer of at least 2, not 1"),
        (lambda: UniformIntervals(0.1, 0.2, 10, ""), "input_record must be"),
    ],
)
def test_impossible_options_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


# --- sizes ----------------------------------------------------------------------------------------


@given(st.integers(50, 1000), st.floats(1.5, 300), st.integers(2, 30))
def test_geometric_sizes(first, ratio, count):
    last = round(first * ratio)
    sizes = geometric_sizes(first, last, count)
    assert (sizes[0], sizes[-1], len(sizes)) == (first, last, count)
    for k, size in enumerate(sizes):
        assert abs(size - first * (last / first) ** (k / (count - 1))) <= 0.5 + 1e-9 * size


@pytest.mark.parametrize(
    ("first", "last", "count", "unrounded", "rounded"),
    [(2000, 100_000, 30, 778_580, 778_581), (500, 123_036, 50, 1_153_484, 1_153_482)],
)
def test_sizes_of_the_published_studies_of_additive_models(first, last, count, unrounded, rounded):
    # The totals that González, Classens, Rojas, Welsh and Oomen print are those of the sizes before rounding.
    exact = [first * (last / first) ** (k / (count - 1)) for k in range(count)]
    assert round(sum(exact)) == unrounded
    assert sum(geometric_sizes(first, last, count)) == rounded


@pytest.mark.parametrize(
    ("sizes", "message"),
    [
        ((500, 500, 3), "the first size must be below the last; they are 500 and 500"),
        ((2, 5, 9), "no 9 different sizes from 2 to 5"),
        ((0, 5, 2), "the first size must be an integer of at least 1, not 0"),
        ((1, 5.5, 2), "the last size must be an integer of at least 1, not 5.5"),
        ((1, 5, 1), "the count must be an integer of at least 2, not 1"),
    ],
)
def test_impossible_sizes_are_refused(sizes, message):
    with pytest.raises(ValueError, match=message):
        geometric_sizes(*sizes)


# --- streams --------------------------------------------------------------------------------------


def test_streams_are_those_of_the_spawn_keys():
    # Stored results are repeatable only as long as these numbers stay what they are.
    assert ROLES == {"input": 0, "sampling": 1, "noise": 2, "start": 3, "parameters": 4, "recorder": 5}
    sequence = np.random.SeedSequence(20170331, spawn_key=(2, 5))
    expected = np.random.default_rng(sequence).standard_normal(3)
    assert np.array_equal(stream(20170331, "noise", 5).standard_normal(3), expected)


def test_streams_differ_by_seed_role_and_replicate():
    draws = {float(stream(s, role, k).random()) for s in (0, 1) for role in ROLES for k in range(5)}
    assert len(draws) == 2 * len(ROLES) * 5
