"""The acceptance numbers of the frequency estimators, with few data sets."""

import pytest

from ctid_cli.studies.claims import near, within
from tests.experiments import frequency_acceptance as acceptance

SHORT = {
    "disturbed": acceptance.disturbed,
    "noisy": lambda: acceptance.noisy(seeds=20, tracked=3),
    "robust": lambda: acceptance.robust(seeds=3),
    "quiet": lambda: acceptance.quiet(seeds=1),
    "efficient": lambda: acceptance.efficient(seeds=12),
}


def test_every_item_has_a_short_version():
    assert SHORT.keys() == acceptance.ITEMS.keys()


@pytest.mark.parametrize("item", SHORT)
def test_item_is_met(item):
    checks = list(SHORT[item]())
    assert checks
    assert [check for check in checks if not check.holds] == []


def test_a_missed_number_is_noticed():
    assert near("name", 1.04, 1.0, 0.05).holds
    assert not near("name", 1.06, 1.0, 0.05).holds
    assert not within("name", None, high=3.0).holds
    assert not within("name", float("nan"), 0.0, 1.0).holds
    assert within("name", 1.0, low=0.5).required == "at least 0.5"
