"""Conversion between parameters and frequencies, and the sentences of flags."""

import numpy as np
from hypothesis import assume, given
from hypothesis import strategies as st

from ctid_cli.frequency.delay_regression import theta_of
from ctid_cli.frequency.flags import Flag
from tests.frequency.signals import frequencies_of

FREQUENCIES = st.lists(st.floats(0.05, 3.0), min_size=1, max_size=8).map(sorted)


@given(FREQUENCIES, st.floats(0.1, 1.0))
def test_frequencies_survive_the_round_trip(omega, delay):
    omega = np.array(omega)
    assume(omega.size == 1 or np.diff(omega).min() > 0.2)
    found, flags = frequencies_of(theta_of(omega, delay), delay)
    # The error of a root is the rounding of the coefficients over the product of its distances to the others.
    c = np.cos(omega * delay)
    distances = [np.prod(np.delete(c[i] - c, i)) for i in range(omega.size)]
    slack = 1e-14 * 2.0**omega.size / np.abs(distances) / (delay * np.sin(omega * delay))
    assume((slack < 0.02).all())
    assert flags == 0
    assert (np.abs(found - omega) <= slack + 1e-14).all()


@given(st.integers(2, 8), st.integers(0, 2**31))
def test_real_roots_are_found_and_complex_ones_are_not(n, seed):
    rng = np.random.default_rng(seed)
    wanted = np.sort(rng.uniform(-1, 1, n))[::-1]
    assume(np.abs(np.diff(wanted)).min() > 0.02)
    omega, flags = frequencies_of(np.poly(wanted)[1:], 1.0)
    assert flags == 0
    np.testing.assert_allclose(np.cos(omega), wanted, atol=1e-6)
    pair = complex(rng.uniform(-1, 1), rng.uniform(0.05, 1))
    coefficients = np.poly([*wanted[:-2], pair, pair.conjugate()]).real
    # Their real parts are returned.
    omega, flags = frequencies_of(coefficients[1:], 1.0)
    assert flags == Flag.COMPLEX_ROOTS
    np.testing.assert_allclose(np.cos(omega), np.sort(np.roots(coefficients).real)[::-1], atol=1e-6)


def test_roots_that_are_no_cosines_are_clipped_and_flagged():
    for roots in ([1.5, -0.2], [0.3, -1.1]):
        omega, flags = frequencies_of(np.poly(roots)[1:], 0.5)
        assert flags == Flag.OUT_OF_BOUNDS
        np.testing.assert_allclose(omega, np.arccos(np.clip(roots, -1.0, 1.0)) / 0.5)


def test_parameters_that_are_no_numbers_give_no_numbers():
    omega, flags = frequencies_of([np.nan, 0.3], 0.5)
    assert np.isnan(omega).all()
    assert flags


def test_every_flag_has_a_sentence():
    everything = Flag(sum(flag for flag in Flag))
    assert len(everything.sentences) == len(Flag)
    assert all(sentence.endswith(".") and len(sentence) > 40 for sentence in everything.sentences)
    assert Flag(0).sentences == ()
    assert (Flag.GAP | Flag.CHANGED).sentences == (*Flag.GAP.sentences, *Flag.CHANGED.sentences)
