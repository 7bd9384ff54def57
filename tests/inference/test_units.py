"""Units of parameters, by their names and the units of the record."""

import pytest

from ctid_cli.inference.units import Units
from ctid_cli.models.additive import AdditiveModel, Submodel


@pytest.mark.parametrize(
    ("poles", "zeros", "units"),
    [
        (4, 1, {"b0": "mm/V/s^3", "b1": "mm/V/s^4", "a1": "1/s", "a4": "1/s^4", "delay": "s"}),
        (3, 1, {"x1": "mm", "x2_2": "mm/s", "x3": "mm/s^2", "offset_1": "mm", "drift": "mm/s", "drift2": "mm/s^2"}),
    ],
)
def test_a_monic_denominator(poles, zeros, units):
    found = Units("s", "V", "mm")
    assert {name: found.of(name, poles, zeros) for name in units} == units


def test_submodels_whose_denominators_end_in_one():
    model = AdditiveModel([Submodel([1.0], [1.0], 2), Submodel([1.0], [0.5, 1.0])])
    units = {"g1_b0": "mm/V/s^2", "g2_a1": "s", "g2_b1": "mm/V*s", "x1": "mm/s", "x2": "mm", "x3": "mm*s"}
    units |= {"delay": "s"}
    assert {name: Units("s", "V", "mm").in_sum(name, model) for name in units} == units


def test_a_divisor_of_several_factors_is_in_parentheses():
    tank = Units("s", "l/s", "m")
    assert (tank.gain, tank.of("b0", 1, 0), tank.square) == ("m/(l/s)", "m/(l/s)/s", "m^2")
    assert (Units(output="1/min").gain, Units(output="1/min").square) == ("1/min/in", "(1/min)^2")


def test_what_is_not_known_is_no_bracket():
    half = Units(output="mm")
    assert (half.label("y", half.output), half.label("gain", half.gain), half.amount("2", half.input)) == (
        "y [mm]",
        "gain",
        "2",
    )
