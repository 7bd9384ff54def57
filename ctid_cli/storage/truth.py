"""Comparison of estimates with true values: estimates under the true names, and the success rule.

An estimate has *converged* if it satisfies every condition of the specification's ``success``:

- ``delay_relative_error``: the estimated delay, or that of each input, differs from the true one by at most this
  fraction of it;
- ``fit_percent``: the fit on the record it was estimated from is at least this [%];
- ``parameter_relative_error``: every parameter but the delay differs from the true one by at most this fraction;
- ``band`` [rad/s] and ``by`` [s]: every frequency of a signal enters the band around the true one and stays there
  within this time after the start and after its last step.

The status does not matter: an estimate that stopped at the iteration limit with the right delay has converged, one
that settled elsewhere has not. An estimate without a result (``FAILED``, ``CRASHED``, ``TIMEOUT``, ``MEMORY``) has not
converged and counts in every percentage. Without ``success``, or without true values, convergence is undefined.

The comparison uses the arrays of ``runs.h5`` by name; :func:`arrays_of_rows` makes them from rows.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ctid_cli.arrays import Array, BoolArray, IndexArray
from ctid_cli.models.several_inputs import is_delay
from ctid_cli.storage import columns
from ctid_cli.storage.column_arrays import AnyArray, ColumnWriter, names_of

#: Columns used in the comparison.
_NAMES = ["status", "fit_percent", "delay", "numerator", "denominator", "parameters", "standard_errors", "quantiles"]
_COLUMNS = [column for column in columns.COLUMNS if column.name in _NAMES]
#: Arrays of estimated values, and arrays of their standard errors and quantiles.
VALUES = ("delay", "numerator", "numerator_length", "denominator", "denominator_length", "parameters")
ERRORS = ("standard_errors", "standard_errors_present", "quantiles")


class Found(NamedTuple):
    """Estimates under the names of the true parameters, NaN if missing, shape (n, p)."""

    values: Array
    standard_errors: Array
    #: Half-widths of 95 % intervals in standard errors [-].
    quantiles: Array


def arrays_of_rows(rows: Sequence[Mapping[str, Any]]) -> dict[str, AnyArray]:
    """Return the arrays needed for a comparison from rows."""
    arrays: dict[str, AnyArray] = {}
    for column in _COLUMNS:
        writer = ColumnWriter(column)
        writer.include(rows)
        arrays |= writer.arrays(rows)
        if column.type == "by name":
            arrays[names_of(column.name)] = np.array(writer.names, dtype=object)
    return arrays


def found_of_rows(rows: Sequence[Mapping[str, Any]], names: Iterable[str]) -> Found:
    """Return the estimates of rows under the true names."""
    return found_under(tuple(names), arrays_of_rows(rows), len(rows))


def found_under(names: Sequence[str], arrays: Mapping[str, AnyArray], count: int) -> Found:
    """Return estimated values, standard errors and interval quantiles under the true names.

    Coefficients are matched by their power of s: for a model with more zeros than the system, the true ``b0`` may be
    ``b1`` of the model. Coefficients of a model with another number of poles have no true values.
    """
    values, errors, quantiles = (_by_name(name, arrays) for name in ("parameters", "standard_errors", "quantiles"))
    if "delay" in arrays:
        values["delay"] = arrays["delay"]
    poles, zeros = coefficients_of("a", names), coefficients_of("b", names)
    if poles and "numerator" in arrays:
        lengths = arrays["numerator_length"]
        alike = (arrays["denominator_length"] == poles + 1) & (lengths >= 0)
        if alike.any():
            _add_coefficients(values, arrays, alike, poles, zeros)
            # The model drops a leading zero; the names of its standard errors keep their powers.
            there = arrays.get("standard_errors_present", np.zeros((count, 0)))
            own = [there[:, k] for k, name in enumerate(errors) if re.fullmatch(r"b\d+", name)]
            longest = np.maximum(lengths, np.sum(own, axis=0, dtype=int) if own else 0)
            for numbers in (errors, quantiles):
                _shift_numerator(numbers, alike, longest - zeros, zeros)
    if prefixes := [name.removesuffix("delay") for name in names if name.endswith("_delay")]:
        _align_inputs(names, prefixes, values, errors, quantiles, count)
    none = np.full(count, np.nan)
    wanted = [[numbers.get(name, none) for name in names] for numbers in (values, errors, quantiles)]
    return Found(*(np.array(some, dtype=np.float64).reshape(len(names), count).T for some in wanted))


def _align_inputs(
    names: Sequence[str],
    prefixes: Sequence[str],
    values: dict[str, Array],
    errors: dict[str, Array],
    quantiles: dict[str, Array],
    count: int,
) -> None:
    """Store coefficients of several inputs under the true names, whose prefixes are the input names."""

    def known(start: str) -> IndexArray:
        there = [np.isfinite(own) for name, own in values.items() if re.fullmatch(rf"{re.escape(start)}\d+", name)]
        return np.asarray(np.sum([np.zeros(count, dtype=int), *there], axis=0, dtype=int))

    alike = np.ones(count, dtype=bool)
    for prefix in ("", *prefixes):
        alike &= known(f"{prefix}a") == coefficients_of(f"{prefix}a", names)
    for prefix in prefixes:
        true = coefficients_of(f"{prefix}b", names)
        shifts = known(f"{prefix}b") - true
        for numbers in (values, errors, quantiles):
            _shift_numerator(numbers, alike, shifts, true, prefix)
    for name in names:
        if not is_delay(name) and name in values:
            values[name] = np.where(alike, values[name], np.nan)


def _by_name(name: str, arrays: Mapping[str, AnyArray]) -> dict[str, Array]:
    """Return numbers by name, each shape (n,)."""
    return dict(zip(arrays[names_of(name)], arrays[name].T, strict=True)) if name in arrays else {}


def coefficients_of(letter: str, names: Iterable[str]) -> int:
    """Return the number of coefficient names with a letter: an optional prefix, the letter, and a number."""
    return sum(re.fullmatch(rf"{re.escape(letter)}\d+", name) is not None for name in names)


def _add_coefficients(
    values: dict[str, Array], arrays: Mapping[str, AnyArray], alike: BoolArray, poles: int, zeros: int
) -> None:
    """Store coefficients under the true names if the model and the system have the same number of poles."""
    numerator, denominator, none = arrays["numerator"], arrays["denominator"], np.full(len(alike), np.nan)
    for k in range(1, poles + 1):
        values[f"a{k}"] = np.where(alike, denominator[:, k], values.get(f"a{k}", none))
    for k in range(zeros):
        places = k + arrays["numerator_length"] - zeros
        own = numerator[np.arange(len(alike)), np.clip(places, 0, numerator.shape[1] - 1)]
        values[f"b{k}"] = np.where(alike, np.where(places < 0, 0.0, own), values.get(f"b{k}", none))


def _shift_numerator(
    numbers: dict[str, Array], alike: BoolArray, shifts: IndexArray, zeros: int, prefix: str = ""
) -> None:
    """Store values of coefficients ``b`` under the true names, shifted by a number of powers in each model."""
    none, own = np.full(len(alike), np.nan), dict(numbers)
    for k in range(zeros):
        found = own.get(f"{prefix}b{k}", none)
        for shift in np.unique(shifts[alike]).tolist():
            found = np.where(alike & (shifts == shift), own.get(f"{prefix}b{k + shift}", none), found)
        numbers[f"{prefix}b{k}"] = found


def failures(arrays: Mapping[str, AnyArray]) -> BoolArray:
    """Return the mask of the failed estimates."""
    return np.isin(arrays["status"], [name.encode() for name in columns.FAILURES])


def satisfied(
    success: Mapping[str, Any] | None,
    truth: Mapping[str, float],
    arrays: Mapping[str, AnyArray],
    values: Array,
    measures: Sequence[Mapping[str, float | None] | None] | None,
) -> BoolArray | None:
    """Return the mask of estimates that satisfy the success rule, from values under the true names; None if no rule."""
    rule, found = success or {}, dict(zip(truth, values.T, strict=True))
    conditions: list[BoolArray] = []
    for name in truth:
        tolerance = rule.get("delay_relative_error" if is_delay(name) else "parameter_relative_error")
        if tolerance is not None:
            conditions.append(_near(found[name], truth[name], tolerance))
    if rule.get("band") is not None and measures is not None:
        from ctid_cli.simulation.frequency_measures import is_settled

        conditions.append(np.array([is_settled(one, rule["band"], rule.get("by")) for one in measures], dtype=bool))
    if rule.get("fit_percent") is not None:
        conditions.append(arrays["fit_percent"] >= rule["fit_percent"])
    return np.logical_and.reduce([~failures(arrays), *conditions]) if conditions else None


def _near(values: Array, true: float, tolerance: float) -> BoolArray:
    return np.abs(values - true) <= tolerance * abs(true)
