"""Two estimators on the same data sets: the result of ``ctid table EXPERIMENT --compare A,B``.

Keys of a row
-------------
- The keys of all tables; ``first`` and ``second`` in place of ``method``: the estimators with their swept options.
- ``measure``: ``percent``, ``rmse`` or ``cpu``, with the ``parameter`` and the ``unit``; ``value``: first minus second,
  with its 95 % interval from ``low`` to ``high``; ``n``: data sets that both have a value for.
- ``p_value`` of no difference; ``adjusted_p_value`` by Holm's correction over ``family``.
- Of percentages: ``only_first`` and ``only_second``, data sets on which only one succeeds; ``failed_ids``: estimates of
  the first on those where only the second does.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ctid_cli.errors import UsageError
from ctid_cli.inference.paired import Difference, holm, median_difference, percent_difference, rms_difference
from ctid_cli.reporting.document import Section
from ctid_cli.reporting.layout import number
from ctid_cli.reporting.measures import Row, labelled_groups, parameter_unit
from ctid_cli.reporting.parameter_errors import ParameterEstimates, common_places, estimates_by_group
from ctid_cli.reporting.results import Group, Results, out_option
from ctid_cli.reporting.table_result import TableResult, labels_of, named, notes_of
from ctid_cli.storage.estimates import Estimates
from ctid_cli.storage.manifest import true_values
from ctid_cli.text import count, did_you_mean

#: Fewer common data sets than these say nothing.
FEWEST = 5
#: Estimates that the text lists.
LISTED = 10
#: What is compared, and how.
METHODS = {
    "percent": "percentages by McNemar's mid-p test, with Tango's score interval",
    "rmse": "RMSE by the paired bootstrap (BCa)",
    "cpu": "median CPU time by the paired bootstrap (BCa)",
}


def compare_estimators(results: Results, names: str, out: Path) -> TableResult:
    """Return the differences of two estimators, given as ``A,B``, on the data sets that both were run on."""
    first, second = _known_pair(results, names)
    rows = paired_rows(results, first, second)
    if not rows:
        raise UsageError(f"{results.experiment}: {first} and {second} have fewer than {FEWEST} data sets in common")
    frame = pd.DataFrame(rows, dtype=object)
    measured = [name for name in METHODS if (frame["measure"] == name).any()]
    tables = [Section(frame=_table(frame[frame["measure"] == name].dropna(axis=1, how="all"))) for name in measured]
    methods = "; ".join(METHODS[name] for name in measured)
    families = "; ".join(frame["family"].unique())
    foot = f"First minus second, 95 % intervals: {methods}. p: adjusted by Holm over the {families}."
    head = Section(f"{results.experiment}: {first} minus {second}, on the same data sets")
    lost = Section(sentences=_lost(results, rows, first, second, out))
    return TableResult(rows, [head, *tables, Section(notes=[foot]), lost], notes_of(results, out))


def _known_pair(results: Results, names: str) -> list[str]:
    """Return the two names, and refuse what is no pair of estimators."""
    pair, every = names.split(","), [part["name"] for part in results.manifest["estimators"]]
    known = list(dict.fromkeys(every))
    if len(pair) != 2:
        raise UsageError(f"--compare takes two estimators, A,B, not {names!r}; there are {', '.join(known)}")
    for name in pair:
        if name not in known:
            hint = did_you_mean(name, known) or "."
            raise UsageError(f"{results.experiment} has no estimator {name!r}{hint} There are {', '.join(known)}")
    if pair[0] == pair[1] and every.count(pair[0]) == 1:
        raise UsageError(f"--compare {names}: {pair[0]} has no swept option; compare it with another estimator")
    return pair


def paired_rows(results: Results, first: str, second: str) -> list[Row]:
    """Return the differences of two estimators of an experiment, or of one with several options, each pair once."""
    members = results.groups()
    simulated = any(map(true_values, results.manifest["data_cells"]))
    estimates = {one.group: one for one in estimates_by_group(results)} if simulated else {}
    labels = {group: row for group, row in labelled_groups(results) if group in members}
    options = results.swept("estimators")
    rows: list[Row] = []
    for one, other in _pairs(list(labels), first, second):
        # An estimator without a start goes with the other's.
        shared = labels[other if one.start == "none" else one]
        shared = {key: value for key, value in shared.items() if key not in ("method", *options)}
        shared |= {
            key: named(group.estimator, labels[group], options) for key, group in (("first", one), ("second", other))
        }
        places = common_places(*(members[group].column("replicate") for group in (one, other)))
        common = [members[group].chosen(some) for group, some in zip((one, other), places, strict=True)]
        found = [*_percentages(*common), *_times(*common)]
        if one in estimates:
            found[1:1] = _errors(estimates[one], estimates[other])
        rows += [shared | row for row in found]
    for measure in METHODS:
        family = [row for row in rows if row["measure"] == measure]
        name = f"{count(len(family), 'difference')} in {measure}"
        for row, adjusted in zip(family, holm([row["p_value"] for row in family]), strict=True):
            row |= {"adjusted_p_value": adjusted, "family": name}
    return rows


def _pairs(groups: Sequence[Group], first: str, second: str) -> Iterator[tuple[Group, Group]]:
    """Yield the groups of both estimators that are of the same data sets, and of the same start if both have one."""
    for k, one in enumerate(groups):
        for other in groups[k + 1 if first == second else 0 :]:
            same_start = one.start == other.start or "none" in (one.start, other.start)
            if (one.estimator, other.estimator, one.cell) == (first, second, other.cell) and same_start:
                yield one, other


def _percentages(one: Estimates, other: Estimates) -> Iterator[Row]:
    """How often each succeeds; without a rule an estimate succeeds that does not fail."""
    if len(one) < FEWEST:
        return
    hits = [~side.failures if side.converged is None else side.converged for side in (one, other)]
    only_first, only_second = hits[0] & ~hits[1], ~hits[0] & hits[1]
    counts = int(only_first.sum()), int(only_second.sum())
    yield {
        **_row("percent", None, "%", len(one), percent_difference(*counts, len(one))),
        **dict(zip(("only_first", "only_second"), counts, strict=True)),
        "failed_ids": one.chosen(only_second).values("id"),
    }


def _errors(one: ParameterEstimates, other: ParameterEstimates) -> Iterator[Row]:
    """Root mean square errors of the parameters that both estimate."""
    sides = list(zip((one, other), common_places(one.replicates, other.replicates), strict=True))
    for name in [name for name in one.names if name in other.names]:
        errors = np.array([side.errors[places, side.names.index(name)] for side, places in sides])
        errors = errors[:, np.isfinite(errors).all(axis=0)]
        if errors.shape[1] >= FEWEST:
            yield _row("rmse", name, parameter_unit(name, one.names), errors.shape[1], rms_difference(*errors))


def _times(one: Estimates, other: Estimates) -> Iterator[Row]:
    """Median processor times."""
    known = np.array([side.column("cpu_seconds") for side in (one, other)])
    known = known[:, np.isfinite(known).all(axis=0)]
    if known.shape[1] >= FEWEST:
        yield _row("cpu", None, "s", known.shape[1], median_difference(*known))


def _row(measure: str, parameter: str | None, unit: str, n: int, difference: Difference) -> Row:
    return {"parameter": parameter, "measure": measure, "unit": unit, **difference._asdict(), "n": n}


def _table(frame: pd.DataFrame) -> pd.DataFrame:
    """Return settings, estimators and parameters down, with the difference, its interval and p-value."""
    several = len(frame[["first", "second"]].drop_duplicates()) > 1
    others = [*(["first", "second"] if several else []), *(["parameter"] if "parameter" in frame else [])]
    first = frame.iloc[0]
    unit = "" if "parameter" in frame else f" [{first['unit']}]"
    texts: dict[str, Any] = {
        f"{first['measure']}{unit}: difference": frame["value"].map(lambda value: number(value, 3)),
        "95 %": [
            f"{number(low, 3)} to {number(high, 3)}" for low, high in zip(frame["low"], frame["high"], strict=True)
        ],
        "p": frame["adjusted_p_value"].map(lambda value: number(value, 2)),
    }
    counts = [name for name in ("only_first", "only_second", "n") if name in frame]
    texts |= {name.replace("_", " "): frame[name] for name in counts}
    return labels_of(frame, *others, options=(*counts, *OWN)).assign(**texts)


#: Keys of a row that are no settings.
OWN = ("first", "second", "p_value", "adjusted_p_value", "family", "failed_ids")


def _lost(results: Results, rows: Sequence[Row], first: str, second: str, out: Path) -> list[str]:
    """Return the estimates of the first that fail on data sets where the second does not, with commands for them."""
    # An estimate of the first can be in several rows, beside other options or starts of the second.
    ids = list(dict.fromkeys(name for row in rows for name in row.get("failed_ids") or ()))
    if not ids:
        return []
    what = f"{count(len(ids), 'estimate')} of {first} missed on data sets where {second} did not:"
    commands = [f"  ctid export {results.experiment} --id {name}{out_option(out)}" for name in ids[:LISTED]]
    more = [f"  and {len(ids) - LISTED} more: --format json has them all"] if len(ids) > LISTED else []
    return ["\n".join([what, *commands, *more])]
