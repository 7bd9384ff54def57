"""What components of one's own may return, and what they may not do."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from ctid_cli import HeldSignal, Record, Srivc, TransferFunction, simulate
from ctid_cli.canonical import plain
from ctid_cli.simulation.dataset import DataSet
from ctid_cli.simulation.own_components import (
    ContractError,
    OwnEstimation,
    OwnExcitation,
    OwnNoise,
    OwnSampling,
    OwnSystem,
    taken,
)


@pytest.fixture(scope="module")
def record():
    rng = np.random.default_rng(1)
    t = 0.1 * np.arange(300.0)
    u = HeldSignal(t, rng.choice([-1.0, 1.0], t.size))
    x = simulate(TransferFunction([2.0], [1.0, 2.0]), u, t)
    return Record(t, x + 0.1 * rng.standard_normal(t.size), u, noise_free=x)


@dataclass
class Answer:
    """Answers whatever it was told to."""

    answer: Any = None
    calls: list[Any] = field(default_factory=list)

    def fit(self, record: Any, start: Any) -> Any:
        self.calls.append(record)
        return self.answer(record) if callable(self.answer) else self.answer

    def generate(self, one: Any, rng: Any) -> Any:
        return self.answer(one) if callable(self.answer) else self.answer

    simulate = fit

    def times(self, rng: Any) -> Any:
        return self.answer


def test_a_mapping_and_a_fit_of_the_same_model_are_stored_alike(record):
    fit = Srivc(poles=1, zeros=0).fit(record)
    answer = {"parameters": fit.parameters, "standard_errors": fit.standard_errors, "status": "CONVERGED"}
    fits = [OwnEstimation(Answer(found)).prepare(record).fit() for found in (answer, fit)]
    one, other = (plain(DataSet(record).result_of(found, None, None)) for found in fits)
    assert other == plain(DataSet(record).result_of(fit, None, None))
    assert one["parameters"] == fit.parameters
    for name in ("status", "delay", "numerator", "denominator", "standard_errors"):
        assert one[name] == other[name]
    for name in ("cost", "fit_percent"):
        assert one[name] == pytest.approx(other[name], rel=1e-9)


def test_free_names_and_failures_that_the_estimator_knows(record):
    found = taken({"parameters": {"tau": np.float32(0.5), "delay": 1}, "message": "quick"}, record, "E.fit")
    result = plain(DataSet(record).result_of(found, None, None))
    assert (result["parameters"], result["numerator"], result["delay"]) == ({"tau": 0.5, "delay": 1.0}, None, 1.0)
    assert (result["message"], result["standard_errors"]) == ("quick", {"tau": None, "delay": None})
    lost = taken({"parameters": {"b0": float("nan"), "a1": None}, "status": "DIVERGED"}, record, "E.fit")
    result = plain(DataSet(record).result_of(lost, None, None))
    assert (result["status"], result["parameters"], result["numerator"]) == ("DIVERGED", {"b0": None, "a1": None}, None)


REFUSED = {
    "type": ((1.0, 2.0), "returned tuple, and a Fit or a mapping"),
    "nothing": (None, "returned NoneType"),
    "key": ({"parameter": {}}, "did you mean 'parameters'"),
    "no parameters": ({"status": "CONVERGED"}, "parameters: NoneType; numbers by name are expected"),
    "empty": ({"parameters": {}}, "returned no parameters"),
    "status": ({"parameters": {"k": 1.0}, "status": "ok"}, "status 'ok'; allowed: CONVERGED, "),
    "nan": ({"parameters": {"k": float("nan")}}, "k is nan; give a status"),
    "array": ({"parameters": {"k": np.ones(2)}}, "k is ndarray; one number is expected"),
    "truth value": ({"parameters": {"k": True}}, "k is bool"),
    "complex": ({"parameters": {"k": 1j}}, "k is complex"),
    "name": ({"parameters": {"a b": 1.0}}, "'a b' cannot be a name"),
    "gap": ({"parameters": {"b0": 1.0, "a2": 1.0}}, "returned a2; the coefficients in descending powers are a1"),
    "zeros": ({"parameters": {"b0": 1.0, "b1": 1.0, "b2": 1.0, "a1": 1.0}}, "too many zeros"),
    "delay": ({"parameters": {"b0": 1.0, "a1": 1.0, "delay": -1.0}}, "a delay of -1 s"),
    "errors": ({"parameters": {"k": 1.0}, "standard_errors": {"m": 1.0}}, "standard errors of m"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_no_fit_is_said_to_be_none(case, record):
    found, words = REFUSED[case]
    with pytest.raises(ContractError) as caught:
        taken(found, record, "E.fit")
    assert str(caught.value).startswith("E.fit returned")
    assert words in str(caught.value)


def set_flags(record):
    record.y.setflags(write=True)
    record.y[0] = 5.0
    return {"parameters": {"k": 1.0}}


def write(record):
    record.inputs[0].values[:] = 0.0


def replace(record):
    object.__setattr__(record, "y", record.y + 1.0)
    return {"parameters": {"k": 1.0}}


@pytest.mark.parametrize("mischief", [set_flags, write, replace])
def test_a_record_that_an_estimator_changes_is_the_same_for_the_next(mischief, record):
    y, u = record.y.copy(), record.input.values.copy()
    with pytest.raises(ContractError, match=r"Answer.fit changes the record that it is given; copy first"):
        OwnEstimation(Answer(mischief)).prepare(record).fit()
    np.testing.assert_array_equal(record.y, y)
    np.testing.assert_array_equal(record.input.values, u)


def test_an_estimator_keeps_nothing_from_one_fit_to_the_next_and_is_not_told_the_truth(record):
    given = []
    options = Answer(lambda record: given.append(record.noise_free) or {"parameters": {"k": 1.0}})
    prepared = OwnEstimation(options).prepare(record)
    prepared.fit()
    prepared.fit()
    assert (options.calls, given) == ([], [None, None])


def test_data_of_the_wrong_kind_are_refused(record):
    t, rng = record.t, np.random.default_rng(0)
    wrong = [
        (
            lambda: OwnNoise(Answer("loud")).generate(t, rng),
            "generate returned str, and an array of 300 finite numbers",
        ),
        (lambda: OwnNoise(Answer(np.ones(3))).generate(t, rng), "shape (3,)"),
        (lambda: OwnNoise(Answer(1.0)).generate(t, rng), "shape ()"),
        (lambda: OwnNoise(Answer(np.full(300, np.inf))).generate(t, rng), "returned inf"),
        (lambda: OwnSystem(Answer(np.full(300, np.nan))).simulate(record.input, t), "returned nan"),
        (lambda: OwnSampling(Answer([0.0, 2.0, 1.0])).times(rng), "instants that increase"),
        (lambda: OwnExcitation(Answer([1.0])).generate(t, rng), "returned list, and a ctid_cli.HeldSignal"),
        (lambda: OwnNoise(Answer(lambda y: y.fill(0.0))).generate(t.copy(), rng), "read-only"),
        (lambda: OwnNoise(Answer(lambda y: y.loud)).generate(t, rng), "AttributeError: 'numpy.ndarray' object has no"),
    ]
    for call, words in wrong:
        with pytest.raises(ContractError) as caught:
            call()
        assert words in str(caught.value)
        assert isinstance(caught.value.component, Answer)
    missing = np.where(np.arange(300) == 5, np.nan, 0.0)
    np.testing.assert_array_equal(OwnNoise(Answer(missing)).generate(t, rng), missing)
