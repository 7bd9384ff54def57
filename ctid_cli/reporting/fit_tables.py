"""Tables and code of a fitted model: responses and residuals over time and frequency, and export to other tools."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ctid_cli.errors import UsageError
from ctid_cli.estimators.frequency_domain import FrequencyDomainFit
from ctid_cli.estimators.identification import Identification, models_of
from ctid_cli.inference.fitted_model import FittedModel
from ctid_cli.inference.model_responses import FrequencyBand, ResponseBand
from ctid_cli.inference.units import Units
from ctid_cli.reporting.document import Table, Tool
from ctid_cli.reporting.layout import picked

if TYPE_CHECKING:
    from ctid_cli.reporting.fit_result import FitResult


def fit_tables(result: FitResult) -> dict[str, Table]:
    """Return the tables of a fit's page by file name; several records are numbered."""
    fitted, units = result.fitted, result.units
    tables = {}
    for k, (name, model) in enumerate(models_of(fitted).items()):
        tail, own = f"_{name}" if name else "", units.of_input(k)
        tables[f"step{tail}.csv"] = response_table(model.step_response(), own)
        tables[f"bode{tail}.csv"] = frequency_table(model.frequency_response(), own)
    if isinstance(fitted.fit, FrequencyDomainFit):
        return tables | {"lines.csv": line_table(fitted.fit, units)}
    several = len(result.records.data) > 1
    for k, record in enumerate(result.records.data):
        number, t = f"_{k + 1}" * several, f"t [{units.time}]"
        used, residuals = fitted.fit.used[k], fitted.fit.residuals[k]
        columns = {t: record.t[used]}
        for i, (name, signal) in enumerate(record.held.items()):
            label = name if record.several else "input"
            columns[units.label(label, units.of_input(i).input)] = signal.at(record.t[used])
        columns[units.label("measured", units.output)] = record.y[used]
        columns[units.label("simulated", units.output)] = record.y[used] - residuals
        tables[f"simulation{number}.csv"] = Table.of_columns(columns)
        left = {t: record.t[used], units.label("residual", units.output): residuals}
        tables[f"residuals{number}.csv"] = Table.of_columns(left)
    return tables


def line_table(fit: FrequencyDomainFit, units: Units) -> Table:
    """Return values, model and residuals at each line of a frequency response."""
    data, model = fit.data, fit.responses_at(fit.data.frequencies)
    columns = {f"frequency [rad/{units.time}]": data.frequencies}
    for name, values in (("", data.response), ("model_", model), ("residual_", data.response - model)):
        columns[units.label(f"{name}real", units.gain)] = values.real
        columns[units.label(f"{name}imaginary", units.gain)] = values.imag
    if data.standard_error is not None:
        columns[units.label("standard_error", units.gain)] = data.standard_error
    return Table.of_columns(columns)


def response_table(band: ResponseBand, units: Units) -> Table:
    """Return a response over time with its standard error and pointwise band."""
    values = picked(band, ("value", "standard_error", "lower", "upper"))
    return Table.of_columns(
        {f"t [{units.time}]": band.t} | {units.label(part, units.gain): value for part, value in values.items()}
    )


def frequency_table(band: FrequencyBand, units: Units) -> Table:
    """Return a frequency response as complex numbers, and as gain and phase with their pointwise bands."""
    columns = {f"frequency [rad/{units.time}]": band.frequencies}
    gains = {"real": band.value.real, "imaginary": band.value.imag}
    gains |= picked(band, ("gain", "gain_error", "gain_lower", "gain_upper"))
    phases = picked(band, ("phase", "phase_error", "phase_lower", "phase_upper"))
    columns |= {units.label(name, units.gain): values for name, values in gains.items()}
    return Table.of_columns(columns | {f"{name} [deg]": np.rad2deg(values) for name, values in phases.items()})


def model_code(fit: FittedModel, tool: Tool, time_unit: str, pade: int | None = None) -> tuple[str, str]:
    """Return a file name and the code that builds a model in another tool, with all digits."""
    if pade is not None and tool != "control":
        raise UsageError(f"--pade is for control, which knows no delays, not for {tool}, where the delay stays exact")
    models = models_of(fit) if isinstance(fit, Identification) else {"": fit}
    variables = {name: "G" + f"_{re.sub(r'[^A-Za-z0-9_]', '_', name)}" * bool(name) for name in models}
    if tool == "matlab":
        parts = [model.to_matlab(variables[name], time_unit=time_unit) for name, model in models.items()]
        parts += [f"G = [{', '.join(variables.values())}];\n"] * (len(models) > 1)
        return "G.m", "".join(parts)
    parts = [model.to_python(variables[name], tool, pade) for name, model in models.items()]
    return f"G_{tool}.py", "\n".join(parts)


def stored_model_code(file: Path, tool: Tool, pade: int | None = None) -> str:
    """Return the code that builds the model of a stored fit in another tool."""
    from ctid_cli.storage.fit_file import read_fit

    stored = read_fit(file)
    return model_code(stored.result, tool, stored.content["units"]["time"], pade)[1]
