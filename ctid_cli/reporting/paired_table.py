"""What ``ctid table EXPERIMENT --compare A,B`` answers: two estimators on the same data sets.

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

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import UsageError
from ctid_cli.inference.paired import Difference, bootstrap_difference, holm, percent_difference
from ctid_cli.reporting.layout import Report, Table, count, delay_label, number
from ctid_cli.reporting.measures import parameter_unit
from ctid_cli.reporting.parameter_errors import ParameterEstimates, common_places, estimates_by_group
from ctid_cli.reporting.percentages import Row, labelled_groups, settings_of
from ctid_cli.reporting.results import Group, Results, out_option
from ctid_cli.reporting.table_blocks import setting_text, setting_title
from ctid_cli.reporting.tables import notes_of
from ctid_cli.storage.estimates import Estimates
from ctid_cli.storage.manifest import true_values
from ctid_cli.text import did_you_mean

#: Fewer common data sets than these say nothing.
FEWEST = 5
#: Estimates that the text lists.
LISTED = 10
#: What is compared, with its method and where its differences are shown.
METHODS = {
    "percent": "percentages by McNemar's mid-p test, with Tango's score interval",
    "rmse": "RMSE by the paired bootstrap (BCa)",
    "cpu": "median CPU time by the paired bootstrap (BCa)",
}
#: Keys of a row that are no settings.
OWN = ("first", "second", "p_value", "adjusted_p_value", "family", "only_first", "only_second", "failed_ids")


def compare_estimators(results: Results, names: str, out: Path) -> Report:
    """Differences of two estimators, given as ``A,B``, on the data sets that both were run on."""
    pair = names.split(",")
    known = list(dict.fromkeys(part["name"] for part in results.manifest["estimators"]))
    if len(pair) != 2:
        raise UsageError(f"--compare takes two estimators, A,B, not {names!r}; there are {', '.join(known)}")
    for name in pair:
        if name not in known:
            hint = did_you_mean(name, known) or "."
            raise UsageError(f"{results.experiment} has no estimator {name!r}{hint} There are {', '.join(known)}")
    if pair[0] == pair[1] and sum(part["name"] == pair[0] for part in results.manifest["estimators"]) == 1:
        raise UsageError(f"--compare {names}: {pair[0]} has no swept option; compare it with another estimator")
    rows = paired_rows(results, pair[0], pair[1])
    if not rows:
        raise UsageError(f"{results.experiment}: {pair[0]} and {pair[1]} have fewer than {FEWEST} data sets in common")
    tables = [[_table([row for row in rows if row["measure"] == name])] for name in METHODS if _has(rows, name)]
    methods = "; ".join(METHODS[name] for name in METHODS if _has(rows, name))
    families = "; ".join(dict.fromkeys(row["family"] for row in rows))
    foot = f"First minus second, 95 % intervals: {methods}. p: adjusted by Holm over the {families}."
    head = [f"### {results.experiment}: {pair[0]} minus {pair[1]}, on the same data sets"]
    return Report([head, *tables, [foot], *_lost(rows, pair, out)], rows, notes_of(results, out))


def paired_rows(results: Results, first: str, second: str) -> list[Row]:
    """Return the differences of two estimators of an experiment, or of one with several options, each pair once."""
    members = results.groups()
    simulated = any(map(true_values, results.manifest["data_cells"]))
    estimates = {one.group: one for one in estimates_by_group(results)} if simulated else {}
    labels = {group: row for group, row in labelled_groups(results) if group in members}
    options = results.swept("estimators")
    rows: list[Row] = []
    for k, one in enumerate(labels):
        for other in list(labels)[k + 1 if first == second else 0 :]:
            if (one.estimator, other.estimator, one.cell) != (first, second, other.cell):
                continue
            if one.start != other.start and "none" not in (one.start, other.start):
                continue
            # An estimator without a start goes with the other's.
            shared = labels[other if one.start == "none" else one]
            shared = {key: value for key, value in shared.items() if key not in ("method", *options)}
            shared |= {"first": _named(one, options), "second": _named(other, options)}
            common = _common(members[one], members[other])
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


def _named(group: Group, options: Sequence[str]) -> str:
    own = zip(options, group.options, strict=True)
    return ", ".join([group.estimator, *(f"{key} {number(value)}" for key, value in own if value is not None)])


def _common(one: Estimates, other: Estimates) -> tuple[Estimates, Estimates]:
    """The estimates of both on the data sets that both have, by replicate."""
    places = common_places(one.column("replicate"), other.column("replicate"))
    return one.chosen(places[0]), other.chosen(places[1])


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
            difference = bootstrap_difference(_root_of_mean, *(errors**2))
            yield _row("rmse", name, parameter_unit(name, one.names), errors.shape[1], difference)


def _times(one: Estimates, other: Estimates) -> Iterator[Row]:
    """Median processor times."""
    known = np.array([side.column("cpu_seconds") for side in (one, other)])
    known = known[:, np.isfinite(known).all(axis=0)]
    if known.shape[1] >= FEWEST:
        yield _row("cpu", None, "s", known.shape[1], bootstrap_difference(_median, *known))


def _root_of_mean(squares: Array) -> Array:
    return np.asarray(np.sqrt(squares.mean(axis=-1)))


def _median(values: Array) -> Array:
    return np.asarray(np.median(values, axis=-1))


def _row(measure: str, parameter: str | None, unit: str, n: int, difference: Difference) -> Row:
    return {"parameter": parameter, "measure": measure, "unit": unit, **difference._asdict(), "n": n}


def _has(rows: Sequence[Row], measure: str) -> bool:
    return any(row["measure"] == measure for row in rows)


def _table(rows: Sequence[Row]) -> Table:
    """Settings, estimators and parameters down."""
    fields = [key for key in settings_of(rows) if key not in OWN and any(row[key] is not None for row in rows)]
    started = any(row["initial_delay"] is not None for row in rows)
    first = rows[0]
    several = any((row["first"], row["second"]) != (first["first"], first["second"]) for row in rows)
    header = [*map(setting_title, fields), *(["initial delay"] if started else [])]
    header += ["first", "second"] if several else []
    header += ["parameter"] if first["parameter"] else []
    left, unit = len(header), "" if first["parameter"] else f" [{first['unit']}]"
    counted = ["only first", "only second"] if first["measure"] == "percent" else []
    header += [f"{first['measure']}{unit}: difference", "95 %", "p", *counted, "n"]
    body = []
    for row in rows:
        cells = [setting_text(key, row[key]) for key in fields]
        cells += [delay_label(row["initial_delay"])] if started else []
        cells += [row["first"], row["second"]] if several else []
        cells += [row["parameter"]] if row["parameter"] else []
        cells += [number(row["value"], 3), f"{number(row['low'], 3)} to {number(row['high'], 3)}"]
        cells += [number(row["adjusted_p_value"], 2)]
        cells += [str(row["only_first"]), str(row["only_second"])] if counted else []
        body.append([*cells, str(row["n"])])
    return Table(header, body, "l" * left + "r" * (len(header) - left))


def _lost(rows: Sequence[Row], pair: Sequence[str], out: Path) -> Iterator[list[str | Table]]:
    """Data sets on which the first fails and the second does not, with the commands that show them."""
    # An estimate of the first can be in several rows, beside other options or starts of the second.
    ids = list(dict.fromkeys(name for row in rows for name in row.get("failed_ids") or ()))
    if ids:
        what = f"{count(len(ids), 'estimate')} of {pair[0]} missed on data sets where {pair[1]} did not:"
        commands = [f"  ctid show {name}{out_option(out)}" for name in ids[:LISTED]]
        more = [f"  and {len(ids) - LISTED} more: --format json has them all"] if len(ids) > LISTED else []
        yield ["\n".join([what, *commands, *more])]
