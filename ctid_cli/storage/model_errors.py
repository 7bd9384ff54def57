"""Errors of estimated models: poles, and distances between responses."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import UsageError
from ctid_cli.models.additive import AdditiveModel
from ctid_cli.models.distances import h2_distance, hinf_distance, matched_poles, response_distance
from ctid_cli.models.factoring import unfactored
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.storage.estimates import Estimates
from ctid_cli.storage.groups import errors_of_group
from ctid_cli.storage.manifest import true_system

if TYPE_CHECKING:
    import pandas as pd

Distance = Callable[[TransferFunction, TransferFunction], float]


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
