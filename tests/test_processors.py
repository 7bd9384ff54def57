"""Work in threads has the same results as without, in order; searches have one thread for linear algebra."""

from dataclasses import dataclass
from threading import Barrier, Event, Thread
from typing import ClassVar

import numpy as np
import pytest
import scipy.linalg  # noqa: F401  it loads a library of its own
from threadpoolctl import OpenBLASController, ThreadpoolController

from ctid_cli import HeldSignal, Record, processors
from ctid_cli.estimation.common import Estimator
from ctid_cli.processors import one_thread


@pytest.mark.parametrize("count", [1, 2, 5])
def test_results_come_in_the_order_of_the_pieces(monkeypatch, count):
    monkeypatch.setattr(processors, "usable_processors", lambda: count)
    assert processors.in_threads(lambda piece: piece**2, range(7)) == [k**2 for k in range(7)]
    assert processors.in_threads(str, []) == []


def test_what_goes_wrong_in_a_thread_is_raised(monkeypatch):
    monkeypatch.setattr(processors, "usable_processors", lambda: 2)
    with pytest.raises(ZeroDivisionError):
        processors.in_threads(lambda piece: 1 / piece, [1, 0])


@pytest.fixture
def threads():
    """Return a function for the number of threads of linear algebra, two outside of searches, set by no thread."""
    controller = ThreadpoolController()

    def number():
        return {one["num_threads"] for one in controller.info() if one["user_api"] == "blas"}

    with controller.limit(limits=2, user_api="blas"):
        OpenBLASController.clear_controlling_thread(force=True)
        if number() != {2}:
            pytest.skip("the linear algebra of this installation has a fixed number of threads")
        yield number


def test_the_last_thread_to_leave_restores_the_threads_of_linear_algebra(threads):
    both, seen = Barrier(2), []

    def search():
        with one_thread:
            both.wait()
            first_left.wait()
            seen.append(threads())

    first_left = Event()
    other = Thread(target=search)
    with one_thread:
        other.start()
        both.wait()
    seen.append(threads())
    first_left.set()
    other.join()
    assert seen == [{1}, {1}]
    assert threads() == {2}


def test_an_error_restores_the_threads_of_linear_algebra(threads):
    @one_thread
    def fail():
        with one_thread:
            assert threads() == {1}
        assert threads() == {1}
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert threads() == {2}


@dataclass(frozen=True)
class CountsThreads(Estimator):
    """Returns the numbers of threads as its estimate."""

    kind: ClassVar[str] = "counts_threads"
    poles: int
    zeros: int

    def _lay_out(self, record):
        return self.count()

    def _estimate(self, data, start):
        return data | self.count()


def test_every_estimator_has_one_thread(threads):
    CountsThreads.count = staticmethod(threads)
    t = np.arange(10.0)
    assert CountsThreads(1, 0).fit(Record(t, t, HeldSignal(t, t))) == {1}
    assert threads() == {2}
