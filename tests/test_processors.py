"""Work in threads has the same results as without threads, in order."""

import pytest

from ctid_cli import processors


@pytest.mark.parametrize("count", [1, 2, 5])
def test_results_come_in_the_order_of_the_pieces(monkeypatch, count):
    monkeypatch.setattr(processors, "usable_processors", lambda: count)
    assert processors.in_threads(lambda piece: piece**2, range(7)) == [k**2 for k in range(7)]
    assert processors.in_threads(str, []) == []


def test_what_goes_wrong_in_a_thread_is_raised(monkeypatch):
    monkeypatch.setattr(processors, "usable_processors", lambda: 2)
    with pytest.raises(ZeroDivisionError):
        processors.in_threads(lambda piece: 1 / piece, [1, 0])
