"""Figures of the study of finite-time frequency estimation: they show the found values."""

import pytest

from ctid_cli.studies.catalogue import find_figures
from tests.reporting.frequency_results import STUDY, run_here

figures = STUDY.module("figures")
NAMES = ("two-tones", "harmonic", "random", "step")
#: A slow clock and short records; the step must occur before their end.
SHORT = ("sampling.interval=0.01", "sampling.duration=33", "success.window=[28, 33]", "monte_carlo.runs=2")


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    folder = tmp_path_factory.mktemp("results")
    for name in NAMES:
        run_here(name, folder, SHORT)
    return folder


def test_the_grey_band_ends_where_finite_time_is_exact(out, drawn):
    for number, end in (("1", 0.66), ("2", 4.74), ("3", 3.2), ("4", 3.6)):
        (item,) = find_figures([f"finite-time-frequency/{number}"])
        item.svg(out)
        (band,) = drawn[-1].axes[3].patches
        assert (band.get_x(), band.get_width()) == pytest.approx((0.0, end))


def test_figures_are_those_of_the_specifications():
    for name in NAMES:
        parts = {part.name: part.estimator.options for part in STUDY.plan(name).estimators}
        shown = {estimator for labels in figures.GROUPS.values() for estimator in labels}
        assert shown == {estimator for estimator, options in parts.items() if not options.whole_record}
        derived = {
            part for part, options in parts.items() if "derived, not the published algorithm" in type(options).__doc__
        }
        assert derived == set(figures.GROUPS[figures.DERIVED])
    assert figures.DERIVED == "derived, not the published algorithm"
    assert figures.DRAWN_INTERVAL == 0.1
