from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from ctid_cli.estimation.common import Start
from ctid_cli.models.additive import Term
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.running.job import DataCell, EstimatorCell, Job, Short, run_job
from ctid_cli.simulation.dataset import DataSet
from ctid_cli.storage.columns import no_result
from ctid_cli.storage.manifest import Key
from tests.running.fakes import STARTS, outcomes_of
from tests.running.toys import FakeFit, FakeRecord, Prepared, Toy, ToySource


@dataclass(frozen=True)
class Counting(Toy):
    """Toy that counts how often records are prepared."""

    def prepare(self, record: FakeRecord) -> Prepared:
        PREPARED.append(record.replicate)
        return super().prepare(record)


PREPARED: list[int] = []


@dataclass(frozen=True)
class Broken:
    error: Exception

    def dataset(self, replicate: int) -> DataSet:
        raise self.error


def data_cell(source: Any) -> DataCell:
    return DataCell({}, "data", {}, source)


def estimator_cell(name: str, estimator: Any) -> EstimatorCell:
    return EstimatorCell(name, "toy", estimator, {}, name, {})


def job(*toys: Toy, source: Any = ToySource(2.0, 1), replicate: int = 2) -> Job:  # noqa: B008
    cells = [estimator_cell(f"toy{k}", toy) for k, toy in enumerate(toys)]
    wanted = tuple((Key("data", replicate, c.name, start.label), c, start) for c in cells for start in STARTS[:2])
    return Job(data_cell(source), replicate, 7, wanted)


def test_a_record_is_prepared_once_for_all_starts() -> None:
    PREPARED.clear()
    outcomes = outcomes_of(job(Counting(), Counting(order=3), replicate=4))
    assert PREPARED == [4, 4]
    assert [outcome.key.estimator_hash for outcome in outcomes] == ["toy0", "toy0", "toy1", "toy1"]


def test_results_do_not_depend_on_what_else_is_wanted() -> None:
    together = outcomes_of(job(Toy(), Toy(order=3)))
    alone = outcomes_of(job(Toy()))
    assert [(o.key, o.result) for o in alone] == [(o.key, o.result) for o in together[:2]]


def test_results_are_plain_and_complete() -> None:
    for outcome in outcomes_of(job(Toy(at=2))):
        assert list(outcome.result) == list(no_result())
        assert json.loads(json.dumps(outcome.result, allow_nan=False)) == outcome.result
        assert outcome.result["standard_errors"] == {"b0": 0.1, "delay": None}
        assert outcome.seconds is not None
        assert outcome.seconds > 0


def test_one_failing_estimator_leaves_the_others_alone() -> None:
    outcomes = outcomes_of(job(Toy("raise", at=2), Toy("unusable"), Toy()))
    assert [outcome.result["status"] for outcome in outcomes] == ["FAILED"] * 4 + ["CONVERGED"] * 2
    assert outcomes[2].result["message"].startswith("DataError: the input is constant")


def test_a_data_set_that_cannot_be_made_fails_every_estimate() -> None:
    outcomes = outcomes_of(job(Toy(), source=Broken(ArithmeticError("no sample"))))
    assert [outcome.result["status"] for outcome in outcomes] == ["FAILED", "FAILED"]
    assert outcomes[0].result["message"].startswith("ArithmeticError: no sample\n  job.py:")


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (MemoryError("no room"), "out of memory: no room"),
        (OSError(24, "Too many open files"), "[Errno 24] Too many open files"),
        (BlockingIOError(11, "no more processes"), "[Errno 11] no more processes"),
    ],
)
def test_what_the_machine_is_short_of_is_no_result(error: Exception, reason: str) -> None:
    def wrapped() -> Exception:
        try:
            try:
                raise error
            except Exception as first:
                raise ValueError("the record cannot be read") from first
        except ValueError as second:
            return second

    for raised in (error, wrapped()):
        wanted = job(Toy(), source=Broken(raised))
        assert outcomes_of(wanted) == []
        assert Short(wanted.keys, reason) in list(run_job(wanted))


@dataclass(frozen=True)
class FractionFit(FakeFit):
    """A fit with the attributes needed for the conversion to submodels."""

    parameter_names: tuple[str, ...] = ("a1", "a2", "b0")
    covariance: np.ndarray[Any, Any] = field(default_factory=lambda: np.diag([0.01, 0.04, 0.09]))


@dataclass(frozen=True)
class Fraction(Toy):
    """Toy that estimates a second-order fraction, and keeps its start."""

    def prepare(self, record: FakeRecord) -> Any:
        return self

    def fit(self, start: Any) -> FractionFit:
        assert start.delay is None
        return FractionFit(TransferFunction([2.0], [1.0, 3.0, 4.0]), {"b0": 0.3, "a1": 0.1, "a2": 0.2}, 1.0)


def test_starts_receive_the_true_system_and_fractions_are_factored() -> None:
    told: list[Any] = []

    @dataclass(frozen=True)
    class Near:
        label: str = "near"

        def draw(self, seed: int, replicate: int, true_model: Any) -> Start:
            told.append((seed, replicate, true_model))
            return Start()

    class Source:
        def dataset(self, replicate: int) -> DataSet:
            return DataSet(FakeRecord(np.ones(3), replicate), "the truth")

    wanted: Any = ((Key("data", 3, "fraction", "near"), estimator_cell("fraction", Fraction()), Near()),)
    (untouched,) = outcomes_of(Job(data_cell(Source()), 3, 7, wanted))
    assert told == [(7, 3, "the truth")]
    assert untouched.result["parameters"] is None
    assert untouched.result["standard_errors"].keys() == {"b0", "a1", "a2"}
    (factored,) = outcomes_of(Job(data_cell(Source()), 3, 7, wanted, (Term(2, 0),)))
    assert factored.result["parameters"] == pytest.approx({"g1_a1": 0.75, "g1_a2": 0.25, "g1_b0": 0.5, "g1_b1": 0.0})
    # a_1 = a1/a2: the relative variances of both are added.
    assert factored.result["standard_errors"]["g1_a1"] == pytest.approx(0.75 * np.hypot(0.1 / 3, 0.2 / 4))
    assert factored.result["standard_errors"].keys() == {"b0", "a1", "a2", *factored.result["parameters"]}
    assert json.loads(json.dumps(factored.result, allow_nan=False)) == factored.result


def test_processor_time_does_not_pass_while_an_estimator_waits() -> None:
    # It does for a busy toy, whatever the load of the machine.
    (waits, *_), (works, *_) = outcomes_of(job(Toy(seconds=0.2))), outcomes_of(job(Toy(seconds=0.2, busy=True)))
    assert waits.seconds is not None
    assert waits.cpu_seconds is not None
    assert works.cpu_seconds is not None
    assert waits.cpu_seconds < 0.1 < 0.2 <= waits.seconds
    assert works.cpu_seconds > waits.cpu_seconds
