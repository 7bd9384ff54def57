"""The acceptance numbers of the frequency estimators; those that need many data sets with few of them."""

import pytest

from experiments.finite_time_frequency import acceptance
from experiments.finite_time_frequency.acceptance import Check

SHORT = {
    "exact": acceptance.exact,
    "gradient": acceptance.gradient,
    "disturbed": acceptance.disturbed,
    "noisy": lambda: acceptance.noisy(seeds=20, tracked=3),
    "steps": acceptance.steps,
    "robust": lambda: acceptance.robust(seeds=3),
    "quiet": lambda: acceptance.quiet(seeds=1),
    "efficient": lambda: acceptance.efficient(seeds=25),
    "coarse": acceptance.coarse,
    "comparators": acceptance.comparators,
}


def test_every_item_has_a_short_version():
    assert SHORT.keys() == acceptance.ITEMS.keys()


@pytest.mark.parametrize("item", SHORT)
def test_item_is_met(item):
    checks = list(SHORT[item]())
    assert checks
    missed = [check for check in checks if not check.met]
    assert not missed


def test_a_missed_number_is_noticed():
    assert acceptance.near("item", "name", 1.04, 1.0, 0.05).met
    assert not acceptance.near("item", "name", 1.06, 1.0, 0.05).met
    assert not acceptance.at_most("item", "name", float("inf"), 3.0).met
    assert not Check("item", "name", float("nan"), 0.0, 1.0).met


def test_the_bound_is_that_of_a_single_tone_where_tones_are_far_apart():
    # 24 sigma^2/(A^2 T^2 N) for a long record.
    bound = acceptance.cramer_rao(200.0, 0.01, 0.1)
    assert bound == pytest.approx([(24 * 0.01 / (200.0**2 * 20_000)) ** 0.5] * 2, rel=0.02)
