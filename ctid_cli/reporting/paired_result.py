"""Two estimators on the same data sets: result of ``ctid table EXPERIMENT --compare A,B``.

Columns
-------
- The keys of all tables; ``first`` and ``second`` in place of ``method``: the estimators with their swept options.
- ``measure``: ``percent``, ``rmse`` or ``cpu``, with the ``parameter`` and the ``unit``; ``value``: first minus second,
  with its 95 % interval from ``low`` to ``high``; ``n``: data sets for which both have a value.
- ``p_value`` of no difference; ``adjusted_p_value`` by Holm's correction over ``family``.
- For percentages: ``only_first`` and ``only_second``, data sets on which only one succeeds; ``failed_ids``: estimates
  of the first where only the second succeeds.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pandas as pd

from ctid_cli.errors import UsageError
from ctid_cli.inference.monte_carlo import MEASURES
from ctid_cli.inference.paired import hit_difference, holm, median_difference, rms_difference
from ctid_cli.progress import reported
from ctid_cli.reporting.document import Section, Table
from ctid_cli.reporting.layout import number
from ctid_cli.reporting.measures import Row, label_frame, parameter_unit, parts_of, records_of, values_of
from ctid_cli.reporting.results import Results, out_option
from ctid_cli.reporting.table_result import TableResult, labels_of, named, notes_of
from ctid_cli.storage.manifest import true_values
from ctid_cli.text import count, did_you_mean

#: Fewest common data sets for a comparison.
FEWEST = 5
#: Most estimates that the text lists.
LISTED = 10
#: Compared measures, and how.
METHODS = {
    "percent": "percentages by McNemar's mid-p test, with Tango's score interval",
    "rmse": "RMSE by the paired bootstrap (BCa)",
    "cpu": "median CPU time by the paired bootstrap (BCa)",
}
DIFFERENCES = {"percent": hit_difference, "rmse": rms_difference, "cpu": median_difference}
#: Keys of a row that are no settings.
OWN = ("first", "second", "p_value", "adjusted_p_value", "family", "failed_ids")


@reported("comparing the estimators")
def compare_estimators(results: Results, names: str, out: Path) -> TableResult:
    """Return the differences of two estimators, given as ``A,B``, on their common data sets."""
    first, second = _known_pair(results, names)
    rows = paired_rows(results, first, second)
    if not rows:
        raise UsageError(f"{results.experiment}: {first} and {second} have fewer than {FEWEST} data sets in common")
    frame = pd.DataFrame(rows, dtype=object)
    measured = [name for name in METHODS if (frame["measure"] == name).any()]
    parts = [frame[frame["measure"] == name].dropna(axis=1, how="all") for name in measured]
    tables = [Section(table=Table.of_frame(_table(part))) for part in parts]
    methods = "; ".join(METHODS[name] for name in measured)
    families = "; ".join(frame["family"].unique())
    foot = f"First minus second, 95 % intervals: {methods}. p: adjusted by Holm over the {families}."
    head = Section(f"{results.experiment}: {first} minus {second}, on the same data sets")
    lost = Section(sentences=_lost(results, frame, first, second, out))
    return TableResult(rows, [head, *tables, Section(notes=[foot]), lost], notes_of(results, out))


def _known_pair(results: Results, names: str) -> list[str]:
    """Return the two names; refuse anything but a pair of estimators."""
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
    options, rows = results.swept("estimators"), list[Row]()
    labels = label_frame(results)
    methods = [named(row["method"], row, options) for row in records_of(labels)]
    shared = records_of(labels.drop(columns=["method", *options]))
    measured = [name for name in METHODS if name != "rmse" or results.is_simulated]
    values = {name: values_of(results, name, MEASURES[name]) for name in measured}
    # Without a rule an estimate succeeds if it does not fail.
    hits = values["percent"]["value"]
    values["percent"]["value"] = hits.fillna(pd.Series(1.0 * ~results.stored.failures))
    for one, other in _pairs(results, first, second):
        # An estimator without a start is compared with every start of the other.
        label = shared[other if results.place(one)[2] == "none" else one]
        label = label | {"first": methods[one], "second": methods[other]}
        for measure, found in values.items():
            rows += [label | row for row in _differences(results, measure, found, (one, other))]
    for measure in METHODS:
        family = [row for row in rows if row["measure"] == measure]
        name = f"{count(len(family), 'difference')} in {measure}"
        for row, adjusted in zip(family, holm([row["p_value"] for row in family]), strict=True):
            row |= {"adjusted_p_value": adjusted, "family": name}
    return rows


def _pairs(results: Results, first: str, second: str) -> Iterator[tuple[int, int]]:
    """Yield the groups of both estimators with the same data sets, and the same start if both have one."""
    groups = results.groups.loc[sorted(set(results.numbers.tolist()))]
    groups = groups.assign(method=[results.manifest["estimators"][k]["name"] for k in groups["estimator"]])
    pairs = groups.reset_index().merge(groups.reset_index(), on="cell", suffixes=("", "_2"))
    pairs = pairs[(pairs["method"] == first) & (pairs["method_2"] == second)]
    same_start = (pairs["start"] == pairs["start_2"]) | (pairs[["start", "start_2"]] == "none").any(axis=1)
    once = pairs["index"] < pairs["index_2"] if first == second else True
    yield from pairs.loc[same_start & once, ["index", "index_2"]].itertuples(index=False, name=None)


def _differences(results: Results, measure: str, values: pd.DataFrame, pair: tuple[int, int]) -> Iterator[Row]:
    """Yield the differences of two groups in one measure, from the values of all groups."""
    one, other = pair
    names = [*true_values(results.manifest["data_cells"][results.place(one)[0]])]
    for (parameter,), own in parts_of(values[values["group"].isin(pair)], "parameter"):
        sides = own.pivot(index="replicate", columns="group", values="value").reindex(columns=pair).dropna()
        if len(sides) < FEWEST:
            continue
        about = {"parameter": parameter if measure == "rmse" else None, "measure": measure}
        unit = parameter_unit(parameter, names) if measure == "rmse" else MEASURES[measure].unit
        difference = DIFFERENCES[measure](*sides.to_numpy().T.copy())
        row = {**about, "unit": unit, **difference._asdict(), "n": len(sides)}
        if measure == "percent":
            only_second = sides.index[sides[one] < sides[other]]
            lost = own.index[(own["group"] == one) & own["replicate"].isin(only_second)]
            row |= {"only_first": int((sides[one] > sides[other]).sum()), "only_second": len(only_second)}
            row["failed_ids"] = results.stored.chosen(lost.to_numpy()).values("id")
        yield row


def _table(frame: pd.DataFrame) -> pd.DataFrame:
    """Return settings, estimators and parameters down, with the difference, its interval and p-value."""
    several = len(frame[["first", "second"]].drop_duplicates()) > 1
    others = [*(["first", "second"] if several else []), *(["parameter"] if "parameter" in frame else [])]
    first = frame.iloc[0]
    unit = "" if "parameter" in frame else f" [{first['unit']}]"
    texts: dict[str, Any] = {
        f"{first['measure']}{unit}: difference": frame["value"].map(lambda value: number(value, 3)),
        "95 %": frame["low"].map(lambda low: f"{number(low, 3)} to ") + frame["high"].map(lambda high: number(high, 3)),
        "p": frame["adjusted_p_value"].map(lambda value: number(value, 2)),
    }
    counts = [name for name in ("only_first", "only_second", "n") if name in frame]
    texts |= {name.replace("_", " "): frame[name] for name in counts}
    return labels_of(frame, *others, options=(*counts, *OWN)).assign(**texts)


def _lost(results: Results, frame: pd.DataFrame, first: str, second: str, out: Path) -> list[str]:
    """Return the estimates of the first that fail where the second succeeds, with commands to show them."""
    # An estimate of the first can be in several rows, with other options or starts of the second.
    ids = frame["failed_ids"].dropna().explode().dropna().unique() if "failed_ids" in frame else ()
    if not len(ids):
        return []
    what = f"{count(len(ids), 'estimate')} of {first} missed on data sets where {second} did not:"
    commands = [f"  ctid export {results.experiment} --id {name}{out_option(out)}" for name in ids[:LISTED]]
    more = [f"  and {len(ids) - LISTED} more: --format json has them all"] if len(ids) > LISTED else []
    return ["\n".join([what, *commands, *more])]
