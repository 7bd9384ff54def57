"""Columns of stored estimates: the single list used by journal, runs.h5, tables, export, JSON and documentation.

A column that is added here, and is given a value where estimates are made, appears in all of them; results stored
before have no value in it.
"""

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

#: Statuses of estimates without a result because of an error.
FAILURES = ("FAILED", "CRASHED", "TIMEOUT", "MEMORY")

ByName = Mapping[str, float | None]


def parameter_names(rows: Iterable[ByName | None]) -> list[str]:
    """Return the names of all parameters in the estimates: b0 ..., a1 ..., of submodels, the delay and others."""

    def place(name: str) -> tuple[int, int, str, int]:
        found = re.fullmatch(r"(?:g(\d+)_)?([ab])(\d+)", name)
        if not found:
            return (2 if name == "delay" else 3, 0, name, 0)
        submodel, letter, power = found.groups()
        return (1, int(submodel), letter, int(power)) if submodel else (0, "ba".index(letter), letter, int(power))

    return sorted({name for row in rows if row for name in row}, key=place)


def measure_names(rows: Iterable[ByName | None]) -> list[str]:
    """Return the names of all measures in the estimates."""
    from ctid_cli.simulation import frequency_measures

    return frequency_measures.measure_names(rows)


def sorted_names(rows: Iterable[ByName | None]) -> list[str]:
    """Return all names in the estimates, sorted."""
    return sorted({name for row in rows if row for name in row})


@dataclass(frozen=True)
class Column:
    """Description of one column."""

    name: str
    #: A pandas type, or a type stored as object in pandas: ``coefficients`` by descending powers, numbers ``by name``,
    #: and an ``initial delay``, which may be the word random.
    type: Literal["str", "int64", "Int64", "float64", "boolean", "coefficients", "by name", "initial delay"]
    meaning: str
    unit: str | None = None
    #: Kinds of experiments with this column; in rows of signals, columns of systems are empty.
    of: Literal["all", "systems", "signals"] = "all"
    #: Origin of its value.
    source: Literal["plan", "result", "clock", "truth"] = "result"
    #: Prefix of the names of its parts in a table with one number per cell.
    prefix: str = ""
    names: Callable[[Iterable[ByName | None]], list[str]] = parameter_names

    @property
    def dtype(self) -> str:
        """Its pandas type."""
        return "object" if self.type in ("coefficients", "by name", "initial delay") else self.type


#: All columns in the order of tables; swept fields precede the columns that are compared with the true values.
COLUMNS = (
    Column("id", "str", "the same data, estimator and start always have the same 12 hexadecimal digits", source="plan"),
    Column("experiment", "str", "name of the experiment", source="plan"),
    Column("estimator", "str", "name from the specification", source="plan"),
    Column("kind", "str", "kind of the estimator", source="plan"),
    Column("cell", "str", "hash of system, excitation, sampling, noise and seed", source="plan"),
    Column("replicate", "int64", "which data set of the cell, from 0", source="plan"),
    Column("start", "str", "start as planned; `none` for estimators without one", of="systems", source="plan"),
    Column(
        *("initial_delay", "initial delay", "where the search was asked to start: a number, `random`, or null", "s"),
        of="systems",
        source="plan",
    ),
    Column("start_delay", "float64", "where the search did start", "s", of="systems"),
    Column("status", "str", "how the estimate ended"),
    Column("message", "str", "the sentence that belongs to the status, or the exception and where it was raised"),
    Column("delay", "float64", "delay", "s", of="systems"),
    Column("numerator", "coefficients", "descending powers", of="systems", prefix="b"),
    Column("denominator", "coefficients", "descending powers, monic", of="systems", prefix="a"),
    Column(
        *(
            "parameters",
            "by name",
            "of submodels (`g1_a1` multiplies s in the denominator of the slowest), or own ones",
        ),
        of="systems",
    ),
    Column("standard_errors", "by name", "of `b0` ..., `a1` ..., `delay` and `parameters`", of="systems", prefix="se_"),
    Column(
        *("covariance", "str"),
        "formula of the standard errors: `white`, `robust`, `bootstrap`; `biased`: none, as a loop is ignored and the "
        "residuals are coloured",
        of="systems",
    ),
    Column("degrees_of_freedom", "float64", "of Student's t, whose quantile intervals reach", "-", of="systems"),
    Column(
        *("quantiles", "by name", "standard errors to each side of the 95 % interval, of the same parameters", "-"),
        of="systems",
        prefix="quantile_",
    ),
    Column(
        *("marks", "str"),
        "what the record does not determine, and the models that a repeating input cannot tell apart",
        of="systems",
    ),
    Column("cost", "float64", "mean squared output error", "output unit^2", of="systems"),
    Column("fit_percent", "float64", "fit on the record that was estimated from", "%", of="systems"),
    Column("validation_fit_percent", "float64", "fit on the rest of a measured record", "%", of="systems"),
    Column("fresh_fit_percent", "float64", "fit on a fresh data set without its noise", "%", of="systems"),
    Column("iterations", "Int64", "in all stages", of="systems"),
    Column(
        "search_delay", "float64", "where `useful_redundancy` ended its search, before refinement", "s", of="systems"
    ),
    Column("switches", "Int64", "how often that search went on behind another filter than before", of="systems"),
    Column("condition_number", "float64", "of the scaled normal equations", "-", of="systems"),
    Column("measures", "by name", "what was measured of the frequencies", of="signals", names=measure_names),
    Column(
        *("custom_measures", "by name", "values of custom measures; none where one raised what the message says"),
        prefix="measure_",
        names=sorted_names,
    ),
    Column("seconds", "float64", "time of this estimate, as if it had been alone", "s", source="clock"),
    Column("cpu_seconds", "float64", "of the processor, called programs included", "s", source="clock"),
    Column("converged", "boolean", "whether it meets the success rule; null without one", source="truth"),
    Column("true_delay", "float64", "delay of the simulated system", "s", of="systems", source="truth"),
)

#: Counts in tables of groups of estimates, with their pandas types.
COUNTS = {
    "n": "int64",
    "failed": "int64",
    "converged": "Int64",
    **dict.fromkeys(("percent", "low", "high", "published_percent", "median_seconds", "median_cpu_seconds"), "float64"),
}


#: Further columns of a row of measures.
OF_MEASURES = ("parameter", "measure", "unit", "value", "error", "without_value")


def reserved_names() -> frozenset[str]:
    """Return the column names of estimates and tables; a swept field with such a name is prefixed with its section."""
    of_tables = ("table", "sampling", "method", *OF_MEASURES)
    return frozenset((*(c.name for c in COLUMNS), *COUNTS, *of_tables))


def failed(message: str, status: str) -> dict[str, Any]:
    """Return the result of an estimate that failed."""
    return no_result() | {"status": status, "message": message}


def no_result() -> dict[str, Any]:
    """Return a result in which every value is missing; texts are empty, as they are after reading."""
    return {column.name: "" if column.type == "str" else None for column in COLUMNS if column.source == "result"}
