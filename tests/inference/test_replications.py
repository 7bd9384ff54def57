"""Stopping rule of data sets until the measures are precise enough."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from ctid_cli.inference.monte_carlo import (
    AT_LEAST,
    Replications,
    Sample,
    Until,
    block_ends,
    decide,
    root_mean_square,
    wilson_interval,
)

NOTHING = np.empty((5000, 0))


def of_hits(hits: Any) -> Replications:
    return Replications(np.asarray(hits, dtype=bool), NOTHING[: len(hits)])


def of_errors(errors: Any) -> Replications:
    return Replications(None, np.asarray(errors).reshape(len(errors), -1))


def test_blocks_grow_to_the_most_that_is_allowed() -> None:
    ends = list(block_ends(1000))
    assert ends == [200, 250, 313, 392, 490, 613, 767, 959, 1000]
    assert list(block_ends(AT_LEAST)) == [AT_LEAST]
    # Another limit changes only the last block.
    assert list(block_ends(2000))[: len(ends) - 1] == ends[:-1]


def test_the_first_block_with_narrow_intervals_of_all_estimators_ends_it() -> None:
    rng = np.random.default_rng(2)
    hits, errors = rng.random(2000) < 0.9, rng.standard_normal(2000)
    until, found = Until(percent_half_width=2.0, rmse_relative=0.06), [of_hits(hits), of_errors(errors)]

    def widths(n: int) -> tuple[float, float]:
        low, high = wilson_interval(int(hits[:n].sum()), n)
        rmse = root_mean_square(Sample(errors[:n], errors[:n]))
        assert rmse.value is not None
        assert rmse.error is not None
        return 50 * (high - low) / 2.0, 1.96 * rmse.error / rmse.value / 0.06

    expected = next(n for n in block_ends(2000) if max(widths(n)) <= 1.0)
    decision = decide(until, found, 2000)
    assert (decision.state, decision.finished, decision.needed) == ("enough", expected, expected)
    assert decision.widest is not None
    assert decision.widest.excess == pytest.approx(max(widths(expected)), rel=1e-4)
    # Together they need the larger of the numbers needed alone.
    assert max(decide(until, [one], 2000).needed for one in found) == expected
    # Later data sets have no effect, and without the last data set of the block there is no decision.
    assert decide(until, [found[0].first(expected), found[1]], 2000) == decision
    before = decide(until, [found[0].first(expected - 1), found[1]], 2000)
    assert (before.state, before.needed) == ("open", expected)
    assert before.finished < expected


def test_what_cannot_be_measured_decides_nothing() -> None:
    rng = np.random.default_rng(4)
    errors = np.column_stack([rng.standard_normal(900), np.zeros(900), np.full(900, np.nan)])
    asked = Until(rmse_relative=0.08)
    # A given parameter has no error, and one that the model lacks has no value.
    assert decide(asked, [of_errors(errors)], 900) == decide(asked, [of_errors(errors[:, :1])], 900)
    # A single value has no standard error.
    once = np.where(np.arange(900) == 3, 1.0, np.nan)
    lonely = decide(asked, [of_errors(once)], 900)
    assert (lonely.state, lonely.needed) == ("at_most", 900)
    assert lonely.widest is not None
    assert lonely.widest.excess == math.inf
    assert decide(asked, [of_errors(np.full(900, np.nan))], 900).needed == AT_LEAST


REPETITIONS = 600


def stopped(until: Until, draw: Any, at_most: int) -> list[Replications]:
    """Return the final results of many studies that follow the rule."""
    found = []
    for _ in range(REPETITIONS):
        whole = draw(at_most)
        found.append(whole.first(decide(until, [whole], at_most).needed))
    return found


@pytest.mark.parametrize("probability", [0.9])
def test_intervals_of_percentages_keep_their_promise_under_the_rule(probability: float) -> None:
    rng = np.random.default_rng(round(1000 * probability))
    found = stopped(Until(percent_half_width=1.5), lambda n: of_hits(rng.random(n) < probability), 5000)
    intervals = [wilson_interval(int(one.hits.sum()), one.hits.size) for one in found if one.hits is not None]
    inside = sum(low <= probability <= high for low, high in intervals)
    # The number that 93 % coverage exceeds with a probability of 99 %: 558 - 2.33 sqrt(600 0.93 0.07).
    assert inside >= 543
    assert max(high - low for low, high in intervals) <= 0.03
    assert len({one.hits.size for one in found if one.hits is not None}) > (1 if probability > 0.5 else 0)
