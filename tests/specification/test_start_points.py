"""Starts at initial parameters: random values and labels."""

import numpy as np
import pytest

from ctid_cli.errors import DataError
from ctid_cli.models.additive import AdditiveModel, Submodel, Term
from ctid_cli.models.factoring import unfactored
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.noise import ROLES, stream
from ctid_cli.simulation.start_points import StartPoint, additive_form
from ctid_cli.specification.system_sections import StartsSection, start_points

TRUE = AdditiveModel([Submodel([0.5], [1.0], 2), Submodel([1.0], [0.025, 0.01, 1.0])], 0.3)


def points(**section):
    return start_points(StartsSection.model_validate(section))


def test_every_parameter_is_drawn_by_itself_around_the_true_one():
    (start,) = points(parameters={"relative_uniform": 0.05})
    drawn = np.array([start.draw(7, replicate, TRUE).model.theta for replicate in range(400)])
    relative = drawn / TRUE.theta - 1
    assert np.abs(relative).max() <= 0.05
    assert relative.max(axis=0) == pytest.approx(0.05, abs=0.002)
    assert relative.min(axis=0) == pytest.approx(-0.05, abs=0.002)
    # Four standard errors of a correlation of 400 pairs.
    correlation = np.corrcoef(relative.T) - np.eye(4)
    assert np.abs(correlation).max() < 4 / np.sqrt(400)
    model = start.draw(7, 0, TRUE).model
    assert (model.terms, model.delay) == (TRUE.terms, 0.3)
    assert start.draw(7, 0, TRUE).delay is None


def test_draws_have_a_stream_of_their_own_and_do_not_depend_on_each_other():
    narrow, wide = points(parameters=[{"relative_uniform": 0.05}, {"relative_uniform": 0.5}])
    first, second = (start.draw(7, 3, TRUE).model.theta / TRUE.theta - 1 for start in (narrow, wide))
    np.testing.assert_allclose(second, 10 * first, rtol=1e-9)
    np.testing.assert_allclose(first, 0.05 * stream(7, "parameters", 3).uniform(-1, 1, 4), rtol=1e-9)
    assert len(set(ROLES.values())) == len(ROLES)
    with pytest.raises(ValueError, match="seed"):
        narrow.draw(None, 3, TRUE)


@pytest.mark.parametrize(
    ("spread", "label"), [(0.05, "5%"), (0.07, "7%"), (0.125, "12.5%"), (0.2, "20%"), (1e-4, "0.01%")]
)
def test_labels_say_the_range(spread, label):
    assert points(parameters={"relative_uniform": spread})[0].label == f"parameters({label})"


def test_given_parameters_are_called_by_their_values():
    def given(gain):
        return {"additive": [{"numerator": [gain], "denominator": [1.0, 1.0]}]}

    one, other = points(parameters=[given(1.0), given(2.0)])
    assert one.label != other.label
    assert one.label == points(parameters=given(1.0))[0].label
    assert other.draw(None, 5).model.theta.tolist() == [1.0, 2.0]
    assert other.initial_delay is None


def test_delays_come_before_parameters():
    found = points(initial_delay=[1, {"uniform": [0, 2]}], parameters={"relative_uniform": 0.05})
    assert [start.label for start in found] == ["1", "uniform(0, 2)", "parameters(5%)"]
    assert start_points(None) == ()


def test_a_fraction_is_drawn_by_its_partial_fractions():
    fraction = unfactored(AdditiveModel([Submodel([1.0], [2.0, 1.0]), Submodel([1.0], [0.025, 0.01, 1.0])]))
    model = StartPoint("parameters(5%)", "parameters", spread=0.05).draw(1, 0, fraction).model
    assert model.terms == (Term(1, 0), Term(2, 1))
    assert model.theta[:2] == pytest.approx([2.0, 1.0], rel=0.051)
    assert additive_form(TRUE) is TRUE
    with pytest.raises(DataError, match="repeated"):
        additive_form(TransferFunction([1.0], [1.0, 2.0, 1.0]))
