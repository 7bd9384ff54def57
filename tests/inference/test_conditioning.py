"""Sentences on parameters that the data do not determine."""

import numpy as np

from ctid_cli.filtering.bank import second_moments
from ctid_cli.filtering.filter_data import filter_data
from ctid_cli.filtering.simulate import simulate
from ctid_cli.inference.covariance import condition_number, describe_conditioning, white_noise_covariance
from ctid_cli.inference.sensitivities import Structure
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.excitation import Prbs
from ctid_cli.signals.record import Record
from ctid_cli.signals.streams import stream

NAMES = ("a1", "b0", "delay")


def described(C, theta, names, number, hessian=None):
    C = np.asarray(C)
    H = hessian if hessian is not None else np.linalg.inv(C) if np.isfinite(C).all() else np.full(C.shape, np.nan)
    return describe_conditioning(C, np.asarray(theta), names, number, np.asarray(H))


def covariance(errors, pairs=()):
    correlation = np.eye(len(errors))
    for i, j, value in pairs:
        correlation[i, j] = correlation[j, i] = value
    return correlation * np.outer(errors, errors)


def test_nothing_is_said_of_a_sound_covariance():
    assert described(covariance([0.1, 0.1, 0.1], [(0, 1, 0.998)]), [1.0, 2.0, 3.0], NAMES, 1e4) == []


def test_a_standard_error_of_many_times_the_value():
    (sentence,) = described(covariance([0.1, 25.0, 0.1]), [1.0, -2.0, 3.0], NAMES, 10.0)
    assert sentence.startswith("b0 = -2 has a standard error of 25, 12 times its value")
    assert described(covariance([0.1, 19.0, 0.1]), [1.0, -2.0, 3.0], NAMES, 10.0) == []
    # an initial state or an offset may be zero
    assert described(covariance([0.1, 0.1]), [1.0, 0.0], ("a1", "offset"), 10.0) == []


def test_two_parameters_that_cannot_be_told_apart():
    C = covariance([0.1, 0.1, 0.1], [(1, 2, -0.9995)])
    (sentence,) = described(C, [1.0, 2.0, 3.0], NAMES, 4000.0)
    assert "b0 and delay can hardly be told apart by these data (correlation -0.99950)" in sentence
    assert "sharper changes" in sentence  # without a zero it is not the zero
    C = covariance([0.1] * 5, [(2, 4, 0.9995)])
    (sentence,) = described(C, [1.0, 2.0, 3.0, 4.0, 5.0], ("a1", "a2", "b0", "b1", "delay"), 4000.0)
    assert "A zero and a delay have nearly the same effect here" in sentence
    assert "use fewer zeros" in sentence


def test_three_parameters_that_cannot_be_told_apart_together():
    # each pair 0.6 to 0.8, but the third is nearly the sum of the others
    rng = np.random.default_rng(1)
    x = rng.standard_normal((1000, 3))
    x[:, 2] = x[:, 0] + x[:, 1] + 0.01 * x[:, 2]
    C = np.cov(x.T)
    (sentence,) = described(C, [5.0, 5.0, 5.0], ("a1", "a2", "b0"), 1e5)
    assert sentence.startswith("a1, a2 and b0 can hardly be told apart by these data (multiple correlations")


def test_a_singular_matrix_names_its_direction():
    H = np.array([[4.0, 0.0, 0.0], [0.0, 1.0, 2.0], [0.0, 2.0, 4.0]])
    undefined = np.full((3, 3), np.nan)
    (sentence,) = described(undefined, [1.0, 2.0, 3.0], NAMES, np.inf, hessian=H)
    assert "do not determine b0 and delay one by one (singular equations); no standard errors can be given" in sentence
    (sentence,) = described(undefined, [1.0, 2.0, 3.0], NAMES, np.inf)
    assert "all the parameters together" in sentence
    (sentence,) = described(undefined, [1.0, 2.0, 3.0], NAMES, np.inf, hessian=np.diag([1.0, 1.0, 0.0]))
    assert sentence.startswith("delay has no effect that these data show")


def test_nearly_singular_is_said_once():
    C = covariance([0.1, 0.1, 0.1], [(1, 2, 1 - 1e-9)])
    (sentence,) = described(C, [1.0, 2.0, 3.0], NAMES, 2e9)
    assert "b0 and delay one by one (condition number 2.0e+09); their standard errors are not reliable" in sentence


def test_a_zero_at_infinity_with_a_free_delay():
    # Without a zero, the leading numerator coefficient and the delay have the same effect: b1 p/A u.
    t = 0.05 * np.arange(1000)
    held = Prbs(stages=9, clock_period=0.5).generate(t, stream(1, "input", 0))
    system = TransferFunction([2.0], [0.25, 0.7, 1.0], 1.0)
    record = Record(t, simulate(system, held, t), held)
    structure = Structure(2, 1, delay=True)
    b = np.array([1e-6, system.numerator[0]])
    H = structure.hessian(second_moments(filter_data(record, 0.0), system.denominator, b, system.delay))
    C = white_noise_covariance(H, 1.0, 1000)
    theta = [*system.denominator[1:], *b, system.delay]
    sentences = " ".join(described(C, theta, structure.names, condition_number(H), hessian=H))
    assert "b0 and delay" in sentences
    assert "A zero and a delay have nearly the same effect here" in sentences
