"""Allowed and refused results of custom components."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

import ctid_cli
from ctid_cli import HeldSignal, Prbs, Record, RegularSampling, Srivc, TransferFunction, WhiteNoise, simulate
from ctid_cli.canonical import plain
from ctid_cli.simulation.components import ComponentError, CustomEstimation, taken
from ctid_cli.simulation.dataset import DataSet, SimulatedSource


@pytest.fixture(scope="module")
def record():
    rng = np.random.default_rng(1)
    t = 0.1 * np.arange(300.0)
    u = HeldSignal(t, rng.choice([-1.0, 1.0], t.size))
    x = simulate(TransferFunction([2.0], [1.0, 2.0]), u, t)
    return Record(t, x + 0.1 * rng.standard_normal(t.size), u, noise_free=x)


@dataclass
class Answer:
    """Component that returns a given value."""

    answer: Any = None
    calls: list[Any] = field(default_factory=list)

    def fit(self, record: Any, start: Any) -> Any:
        self.calls.append(record)
        return self.answer(record) if callable(self.answer) else self.answer

    def generate(self, one: Any, rng: Any) -> Any:
        return self.answer(one) if callable(self.answer) else self.answer

    simulate = fit
    input_record = "exact"

    def times(self, rng: Any) -> Any:
        return self.answer


def test_a_mapping_and_a_fit_of_the_same_model_are_stored_alike(record):
    fit = Srivc(poles=1, zeros=0).fit(record)
    answer = {"parameters": fit.parameters, "standard_errors": fit.standard_errors, "status": "CONVERGED"}
    fits = [CustomEstimation(Answer(found)).prepare(record).fit() for found in (answer, fit)]
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
def test_invalid_results_are_refused(case, record):
    found, words = REFUSED[case]
    with pytest.raises(ComponentError) as caught:
        taken(found, record, "E.fit")
    assert str(caught.value).startswith("E.fit returned")
    assert words in str(caught.value)


def set_flags(record):
    record.y.setflags(write=True)
    record.y[0] = 5.0
    return {"parameters": {"k": 1.0}}


def write(record):
    record.input.values[:] = 0.0


def replaced(record):
    object.__setattr__(record, "y", record.y + 1.0)
    return {"parameters": {"k": 1.0}}


@pytest.mark.parametrize("mischief", [set_flags, write, replaced])
def test_changes_of_a_record_are_refused_and_undone(mischief, record):
    y, u = record.y.copy(), record.input.values.copy()
    with pytest.raises(ComponentError, match=r"Answer.fit changes the record that it is given; copy first"):
        CustomEstimation(Answer(mischief)).prepare(record).fit()
    np.testing.assert_array_equal(record.y, y)
    np.testing.assert_array_equal(record.input.values, u)


def test_a_custom_estimator_is_copied_for_each_fit_and_receives_no_truth(record):
    given = []
    options = Answer(lambda record: given.append(record.noise_free) or {"parameters": {"k": 1.0}})
    prepared = CustomEstimation(options).prepare(record)
    prepared.fit()
    prepared.fit()
    assert (options.calls, given) == ([], [None, None])


def test_classes_of_ctid_are_what_custom_ones_derive_from():
    assert isinstance(TransferFunction([1.0], [1.0, 1.0]), ctid_cli.System)
    assert isinstance(Prbs(stages=5, clock_period=0.1), ctid_cli.Excitation)
    assert isinstance(RegularSampling(0.1, 10), ctid_cli.Sampling)
    assert isinstance(WhiteNoise(variance=1.0), ctid_cli.Noise)
    assert isinstance(Srivc(poles=1, zeros=0), ctid_cli.Estimator)


SOURCE = SimulatedSource(
    TransferFunction([2.0], [1.0, 2.0]), Prbs(stages=6, clock_period=0.5), RegularSampling(0.1, 300), None, seed=1
)
READ_ONLY = "failed: ValueError: assignment destination is read-only"


@pytest.mark.parametrize(
    ("part", "answer", "words"),
    [
        ("noise", "loud", "generate returned str, and an array of 300 finite numbers"),
        ("noise", np.ones(3), "shape (3,)"),
        ("noise", 1.0, "shape ()"),
        ("noise", np.full(300, np.inf), "returned inf"),
        ("noise", lambda y: y.fill(0.0), READ_ONLY),
        ("noise", lambda y: y.loud, "failed: AttributeError: 'numpy.ndarray' object has no"),
        ("system", np.full(300, np.nan), "returned nan"),
        ("sampling", [0.0, 2.0, 1.0], "instants that increase"),
        ("excitation", [1.0], "returned list, and a ctid_cli.HeldSignal"),
    ],
)
def test_data_of_the_wrong_kind_are_refused(part, answer, words):
    with pytest.raises(ComponentError) as caught:
        replace(SOURCE, **{part: Answer(answer)}).dataset(0)
    assert words in str(caught.value)
    assert caught.value.section == part


def test_a_noise_may_lose_samples():
    missing = np.where(np.arange(300) == 5, np.nan, 0.0)
    record = replace(SOURCE, noise=Answer(missing)).dataset(0).record
    np.testing.assert_array_equal(record.y, record.noise_free + missing)
