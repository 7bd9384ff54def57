"""Kinds of figures of the results of any experiment."""

from collections.abc import Sequence
from typing import Literal, get_args

from ctid_cli.errors import UsageError
from ctid_cli.reporting.figures.estimate_plot import box_drawing
from ctid_cli.reporting.figures.measure_plot import measure_drawing
from ctid_cli.reporting.figures.style import Drawing, require_kind
from ctid_cli.reporting.measures import default_measures, requested_measures
from ctid_cli.reporting.results import Results

Kind = Literal["measure", "box"]


def kinds_of(results: Results) -> list[Kind]:
    """Return the figures that an experiment has, the most informative one first."""
    if not len(results.stored):
        raise UsageError(f"{results.experiment} has no stored estimates yet; run it first")
    if results.settings.get("data") is not None:
        one = f"{results.experiment} has one measured record, and these figures show several data sets"
        raise UsageError(f"{one}; ctid fit draws a fit")
    kinds: list[Kind] = ["measure"]
    if results.is_simulated:
        kinds += ["box"]
    alone = len(set(results.numbers.tolist())) == 1 and "box" in kinds
    return sorted(kinds, key=lambda kind: kind != "box") if alone else kinds


def main_measure(results: Results) -> str:
    """Return the default measure: that of the specification, its rule of success, or the errors."""
    named = requested_measures(results)
    if not named and results.settings.get("success"):
        return "percent"
    # The root mean square error, the last one, is more informative than the bias.
    return next(reversed(default_measures(results) if not named else named[:1]), "cpu")


def chosen_kind(results: Results, kind: str | None = None, measure: str | None = None) -> Kind:
    """Return the requested kind of figure, or the most informative one."""
    known = kinds_of(results)
    if kind is None:
        return "measure" if measure is not None else known[0]
    require_kind(kind, get_args(Kind))
    if kind not in known:
        raise UsageError(f"{results.experiment} has no figure of kind {kind}; it has {', '.join(known)}")
    return kind


def experiment_drawing(
    results: Results, kind: str | None = None, measure: str | None = None, parameters: Sequence[str] = ()
) -> Drawing:
    """Return a figure of an experiment."""
    chosen = chosen_kind(results, kind, measure)
    if chosen == "measure":
        if parameters:
            raise UsageError(f"--parameters goes with --kind box; for one parameter: --measure rmse:{parameters[0]}")
        return measure_drawing(results, measure or main_measure(results))
    if measure is not None:
        raise UsageError(f"--measure goes with --kind measure, not {chosen}")
    return box_drawing(results, parameters)
