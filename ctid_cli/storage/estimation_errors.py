"""Groups of estimates, by data cell, estimator and start, and errors of parameters, poles and responses.

Every estimate with a value for each parameter of the system counts, converged or not. An estimate that failed, or has
no value in these parameters, has no error.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from ctid_cli.arrays import Array, IndexArray
from ctid_cli.errors import UsageError
from ctid_cli.inference import monte_carlo
from ctid_cli.models.additive import AdditiveModel
from ctid_cli.models.distances import h2_distance, hinf_distance, matched_poles, response_distance
from ctid_cli.models.factoring import unfactored
from ctid_cli.models.several_inputs import is_delay
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.storage.estimates import Estimates
from ctid_cli.storage.manifest import Manifest, true_system, true_values
from ctid_cli.storage.truth import Found

if TYPE_CHECKING:
    import pandas as pd

#: Columns of parameter errors.
COLUMNS = ("group", "parameter", "replicate", "true", "value", "standard_error", "quantile")
#: Distance of an estimated model from the simulated one.
Distance = Callable[[TransferFunction, TransferFunction], float]


def planned_groups(manifest: Manifest) -> pd.DataFrame:
    """Return the planned groups, numbered from 0: data cell and estimator by their places in the plan, and start."""
    import pandas as pd

    rows = [
        (cell, number, start)
        for cell in range(len(manifest["data_cells"]))
        for number, estimator in enumerate(manifest["estimators"])
        for start in estimator["starts"]
    ]
    return pd.DataFrame(rows, columns=["cell", "estimator", "start"])


def group_numbers(stored: Estimates) -> IndexArray:
    """Return the number of the planned group of each estimate, shape (n,)."""
    manifest = stored.manifest
    groups = planned_groups(manifest).itertuples(index=False, name=None)
    numbers = {group: number for number, group in enumerate(groups)}
    cells = {cell["hash"]: k for k, cell in enumerate(manifest["data_cells"])}
    estimators = {(part["hash"], part["name"]): k for k, part in enumerate(manifest["estimators"])}
    starts, found = stored.column("start"), np.empty(len(stored), dtype=int)
    for block in stored.blocks:
        own = slice(block.first, block.last)
        labels, places = np.unique(starts[own], return_inverse=True)
        at = cells[block.cell["hash"]], estimators[block.hash, block.estimator["name"]]
        found[own] = np.array([numbers[(*at, label.decode())] for label in labels.tolist()])[places]
    return found


def places_of(numbers: IndexArray) -> dict[int, IndexArray]:
    """Return the places of the estimates of each group, from the group numbers of all estimates."""
    order = np.argsort(numbers, kind="stable")
    groups, first = np.unique(numbers[order], return_index=True)
    return dict(zip(groups.tolist(), np.split(order, first[1:]), strict=True)) if len(order) else {}


# --- parameters -----------------------------------------------------------------------------------------------------


def error_frame(stored: Estimates, numbers: IndexArray) -> pd.DataFrame:
    """Return one row for each parameter of each estimate of a simulated system, from their group numbers.

    Columns: ``group``, ``parameter``, ``replicate``; ``true``; ``value``: estimate minus true value, NaN if the
    estimate does not count; its ``standard_error``, NaN if missing; ``quantile``, half-width of the 95 % interval in
    standard errors [-]. A given delay, which is constant and without an error, has no rows.
    """
    import pandas as pd

    groups = planned_groups(stored.manifest)
    truths = [true_values(cell) for cell in stored.manifest["data_cells"]]
    members = {number: stored.chosen(places) for number, places in places_of(numbers).items()}
    cells = groups["cell"].to_dict()
    found = {number: rows.found(tuple(truths[cells[number]])) for number, rows in members.items()}
    parts, given = [], _given_delays(groups, truths, found)
    for number, (values, errors, quantiles) in found.items():
        truth = truths[cells[number]]
        kept = np.array([(groups["estimator"][number], name) not in given for name in truth], dtype=bool)
        names, true = np.array([*truth], dtype=object)[kept], np.array([*truth.values()])[kept]
        values, errors, quantiles = values[:, kept], errors[:, kept], quantiles[:, kept]
        values[~monte_carlo.complete(values)] = np.nan
        # Quantiles are missing in older results and from estimators that give none.
        quantiles = np.where(np.isnan(quantiles), monte_carlo.QUANTILE, quantiles)
        replicates = members[number].column("replicate")
        parts.append(errors_of_group(number, replicates, names, true, values, errors, quantiles))
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=COLUMNS)


def _given_delays(
    groups: pd.DataFrame, truths: Sequence[dict[str, float]], found: dict[int, Found]
) -> set[tuple[int, str]]:
    """Return the places of estimators with the names of the delays that they do not estimate."""
    delays: dict[tuple[int, str], list[Array]] = {}
    for number, (values, errors, _) in found.items():
        cell, estimator = groups.iloc[number, :2].tolist()
        for k, name in enumerate(truths[cell]):
            if is_delay(name):
                delays.setdefault((estimator, name), []).append(np.array([values[:, k], errors[:, k]]))
    given = set()
    for place, parts in delays.items():
        values, errors = np.hstack(parts)
        known = values[np.isfinite(values)]
        if np.isnan(errors).all() and (known == known[:1]).all():
            given.add(place)
    return given


def errors_of_group(
    number: int,
    replicates: IndexArray,
    names: Sequence[str],
    true: Array,
    values: Array,
    errors: Array | None = None,
    quantiles: Array | None = None,
) -> pd.DataFrame:
    """Return the rows of one group, from values, standard errors and quantiles, each shape (n, p)."""
    import pandas as pd

    n, p = values.shape
    none, expected = np.full_like(values, np.nan), np.repeat(true, n)
    columns = (
        np.full(n * p, number),
        np.repeat(np.asarray(names, dtype=object), n),
        np.tile(replicates, p),
        expected,
        values.T.ravel() - expected,
        (none if errors is None else errors).T.ravel(),
        (none if quantiles is None else quantiles).T.ravel(),
    )
    return pd.DataFrame(dict(zip(COLUMNS, columns, strict=True)))


# --- poles and responses ----------------------------------------------------------------------------------------------


def system_of(cell: Mapping[str, Any], name: str) -> TransferFunction:
    """Return the simulated system of a data cell as one fraction, for a measure that needs it."""
    system = true_system(cell)
    model = unfactored(system) if isinstance(system, AdditiveModel) else system
    if not isinstance(model, TransferFunction):
        what = "with one input that is simulated"
        raise UsageError(f"{name} needs a linear system of poles and zeros {what}, and there is none here")
    if name in ("h2", "hinf") and not model.is_stable:
        raise UsageError(f"{name} is infinite for a system that integrates; use response:FREQUENCY")
    return model


def distances(system: TransferFunction, rows: Estimates, name: str) -> Array:
    """Return the distances of estimates for a measure [%]; infinite if there is no model."""
    base, _, argument = name.partition(":")
    known: dict[str, Distance] = {"h2": h2_distance, "hinf": hinf_distance}
    distance = partial(response_distance, frequency=float(argument)) if base == "response" else known[base]
    models = rows.rows("numerator", "denominator", "delay")
    return np.array([100.0 * distance(system, _model(row)) if row["denominator"] else np.inf for row in models])


def _model(row: Mapping[str, Any]) -> TransferFunction:
    return TransferFunction(row["numerator"], row["denominator"], max(row["delay"] or 0.0, 0.0))


def pole_errors(group: int, system: TransferFunction, rows: Estimates) -> pd.DataFrame:
    """Return pole errors in the form of parameter errors, each with the matched true pole [rad/s].

    Names are ``pole_1`` ..., fastest first; ``pole_1_real`` and ``pole_1_imag`` for complex pairs. A model with another
    number of poles has no errors.
    """
    true = system.poles
    found = np.array([true, *(matched_poles(true, denominator) for denominator in rows.values("denominator"))])
    columns: dict[str, Array] = {}
    for number, k in enumerate(np.flatnonzero(true.imag >= 0).tolist(), start=1):
        if true[k].imag:
            columns |= {f"pole_{number}_real": found[:, k].real, f"pole_{number}_imag": found[:, k].imag}
        else:
            columns[f"pole_{number}"] = found[:, k].real
    values = np.column_stack([*columns.values()])
    return errors_of_group(group, rows.column("replicate"), [*columns], values[0], values[1:])
