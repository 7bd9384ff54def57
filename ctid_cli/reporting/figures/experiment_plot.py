"""The figures that the results of any experiment can be drawn as."""

from collections.abc import Sequence
from typing import Literal, get_args

from ctid_cli.errors import UsageError
from ctid_cli.reporting.figures.estimate_plot import box_drawing
from ctid_cli.reporting.figures.measure_plot import measure_drawing
from ctid_cli.reporting.figures.style import Drawing, require_kind
from ctid_cli.reporting.measures import asked_measures, default_measures
from ctid_cli.reporting.results import Results

Kind = Literal["measure", "box"]


def kinds_of(results: Results) -> list[Kind]:
    """The figures that an experiment has, the most telling one first."""
    if not len(results.stored):
        raise UsageError(f"{results.experiment} has no stored estimates yet; run it first")
    if results.settings.get("data") is not None:
        one = f"{results.experiment} is about one measured record, so that there is nothing to draw over data sets"
        raise UsageError(f"{one}; ctid fit draws a fit")
    kinds: list[Kind] = ["measure"]
    if results.is_simulated:
        kinds += ["box"]
    alone = len(set(results.numbers.tolist())) == 1 and "box" in kinds
    return sorted(kinds, key=lambda kind: kind != "box") if alone else kinds


def main_measure(results: Results) -> str:
    """What is measured where nothing is said: what the specification asks for, its rule of success, or the errors."""
    asked = asked_measures(results)
    if not asked and results.settings.get("success"):
        return "percent"
    # The last one of bias and root mean square error tells more.
    return next(reversed(default_measures(results) if not asked else asked[:1]), "cpu")


def chosen_kind(results: Results, kind: str | None = None, measure: str | None = None) -> Kind:
    """The kind of figure that was asked for, or the most telling one."""
    known = kinds_of(results)
    if kind is None:
        return "measure" if measure is not None else known[0]
    require_kind(kind, get_args(Kind))
    if kind not in known:
        raise UsageError(f"{results.experiment} has nothing to draw as {kind}; it has {', '.join(known)}")
    return kind


def experiment_drawing(
    results: Results, kind: str | None = None, measure: str | None = None, parameters: Sequence[str] = ()
) -> Drawing:
    """A figure of an experiment."""
    chosen = chosen_kind(results, kind, measure)
    if chosen == "measure":
        if parameters:
            raise UsageError(f"--parameters goes with --kind box; for one parameter: --measure rmse:{parameters[0]}")
        return measure_drawing(results, measure or main_measure(results))
    if measure is not None:
        raise UsageError(f"--measure goes with --kind measure, not {chosen}")
    return box_drawing(results, parameters)
