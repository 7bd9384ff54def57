"""Choice of the structure of a model of a frequency response."""

from dataclasses import replace

import numpy as np
import pytest

from ctid_cli import (
    Fixed,
    FrequencyData,
    Given,
    HeldSignal,
    Record,
    TransferFunction,
    estimate_frequency_response,
    identify_frequency_response,
    simulate,
)
from ctid_cli.errors import DataError, OptionError
from ctid_cli.identification.choose_response import choose_response
from ctid_cli.identification.response_structures import greatest_delay

TWO = TransferFunction([2.0], [1.0, 0.6, 1.0])
#: Two resonances, with the antiresonance between them.
FOUR = TransferFunction([1.0, 0.1, 4.0], np.polymul([1.0, 0.06, 1.0], [1.0, 0.3, 9.0]))

#: No delay, and no integrator.
KNOWN = Given(integrators=0, delay_bounds=(0.0, 0.0))


def lines(model, count=80, level=0.01, scale=1.0, seed=0, *, stated=True, ends=(0.1, 10.0), even=False):
    """Return lines of a model with a noise relative to the root mean square gain; ``scale`` multiplies frequencies."""
    w = np.linspace(*ends, count) if even else np.geomspace(*ends, count)
    values, rng = model.frequency_response(w), np.random.default_rng(seed)
    size = level * np.sqrt(np.mean(np.abs(values) ** 2))
    noise = size * (rng.standard_normal(count) + 1j * rng.standard_normal(count)) / np.sqrt(2.0)
    return FrequencyData(w * scale, values + noise, np.full(count, size) if stated else None)


def structure(options):
    """Return poles, zeros, integrators and whether there is a delay."""
    return options.poles, options.zeros, options.integrators, options.delay_bounds[1] > 0.0


@pytest.mark.parametrize(("scale", "stated", "delay"), [(2e-3, True, 0.0), (2e9, True, 0.7), (2e9, False, 0.0)])
def test_two_poles_are_chosen_at_any_frequency(scale, stated, delay):
    model = TransferFunction(TWO.numerator, TWO.denominator, delay)
    choice = choose_response(lines(model, 60, scale=scale, stated=stated))
    assert structure(choice.options) == (2, 0, 0, delay > 0.0)
    assert choice.taken.fit.model.delay * scale == pytest.approx(delay, abs=0.02)


def test_the_scale_of_frequency_changes_nothing():
    found = [choose_response(lines(FOUR, 60, scale=scale), KNOWN) for scale in (1.0, 1e12)]
    assert found[0].words()[:4] == found[1].words()[:4]
    names = [[(one.name, one.options.delay_bounds[1] > 0.0) for one in each.judged[:3]] for each in found]
    assert names[0] == names[1]
    assert found[0].taken.criterion == pytest.approx(found[1].taken.criterion, abs=1e-3)


def test_four_poles_with_their_zeros_are_chosen_without_standard_errors():
    assert structure(choose_response(lines(FOUR, stated=False), KNOWN).options) == (4, 2, 0, False)


def test_an_integrator_is_found():
    model = TransferFunction([1.0], [1.0, 1.0, 0.0])
    assert structure(choose_response(lines(model, level=0.003)).options) == (1, 0, 1, False)


@pytest.mark.slow
def test_peaks_raise_the_limit_to_eight_poles():
    parts = [(1.0, 0.02), (2.0, 0.015), (4.0, 0.01), (7.0, 0.008)]
    w = np.linspace(0.3, 10.0, 200)
    values = sum(p**2 / (p**2 - w**2 + 2j * z * p * w) for p, z in parts)
    rng = np.random.default_rng(0)
    noise = 0.05 * (rng.standard_normal(w.size) + 1j * rng.standard_normal(w.size))
    given = Given(delay_bounds=(0.0, 0.0), zeros=(6, 6), integrators=0)
    choice = choose_response(FrequencyData(w, values + noise, np.full(w.size, 0.05 * np.sqrt(2.0))), given)
    assert structure(choice.options) == (8, 6, 0, False)
    assert any("4 clear peaks" in text for text in choice.sentences)
    assert choice.missed == ()


def test_a_peak_that_the_choice_misses_is_named():
    found = identify_frequency_response(lines(FOUR, 120, 0.003), replace(KNOWN, poles=(1, 3)))
    assert any(text.startswith("A peak at ") and "is not described by the chosen" in text for text in found.warnings)


def test_given_options_are_kept():
    data = lines(TransferFunction(TWO.numerator, TWO.denominator, 0.7), 60)
    options = choose_response(data, Given(poles=2, delay_bounds=(0.5, 1.0))).options
    assert (options.poles, options.zeros, options.delay_bounds) == (2, 0, (0.5, 1.0))
    options = choose_response(data, Given(poles=(1, 3), zeros=1, integrators=0, delay_bounds=(0.7, 0.7))).options
    assert (options.zeros, options.integrators, options.delay_bounds) == (1, 0, (0.7, 0.7))


def test_a_known_coefficient_is_kept_and_an_impossible_one_refused():
    data = lines(TWO, 60)
    options = choose_response(data, replace(KNOWN, poles=2, fixed=(Fixed("a2", 1.0),))).options
    assert (options.zeros, options.fixed) == (0, (Fixed("a2", 1.0),))
    with pytest.raises(OptionError, match="a7"):
        choose_response(data, replace(KNOWN, poles=2, fixed=(Fixed("a7", 1.0),)))


def test_options_of_records_and_too_few_lines_are_refused():
    with pytest.raises(OptionError, match="offset is not available"):
        choose_response(lines(TWO), Given(offset="none"))
    with pytest.raises(DataError, match="give more frequencies"):
        choose_response(lines(TWO, 2), KNOWN)


def test_the_chosen_model_is_that_of_its_options():
    data = lines(TWO, 60)
    chosen = identify_frequency_response(data)
    typed = identify_frequency_response(data, chosen.options)
    assert chosen.fit.theta == pytest.approx(typed.fit.theta, rel=1e-6)
    assert chosen.choices
    assert not typed.choices
    assert all(text.endswith(".") for text in chosen.choices)


def test_correlated_lines_of_a_record_are_whitened():
    t, rng = 0.5 * np.arange(500), np.random.default_rng(3)
    signal = HeldSignal(t, rng.standard_normal(t.size), "zoh")
    noise = np.convolve(rng.standard_normal(t.size), [0.1, 0.09, 0.08], "same")
    data = estimate_frequency_response(Record(t, simulate(TWO, signal, t) + noise, signal)).data
    assert data.correlated
    choice = choose_response(data)
    assert choice.noise_order > 0
    assert choice.options.poles == 2


@pytest.mark.parametrize("even", [True, False])
def test_the_range_of_the_delay_contains_it(even):
    model = TransferFunction(TWO.numerator, TWO.denominator, 5.0)
    assert greatest_delay(lines(model, 200, even=even), 0.01) > 5.0
    assert greatest_delay(lines(TWO, 200, even=even), 0.01) < 10.0
