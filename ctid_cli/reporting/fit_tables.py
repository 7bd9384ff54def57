"""Tables and code of a fitted model: its responses and residuals over time and frequency, and the model elsewhere."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from ctid_cli.errors import UsageError
from ctid_cli.estimators.identification import Identification, models_of
from ctid_cli.inference.fitted_model import FittedModel
from ctid_cli.inference.model_responses import FrequencyBand, ResponseBand
from ctid_cli.reporting.document import Tool
from ctid_cli.reporting.estimate import Units

if TYPE_CHECKING:
    from ctid_cli.reporting.fit_result import FitResult


def fit_tables(result: FitResult) -> dict[str, pd.DataFrame]:
    """Return what the page of a fit shows as tables by the names of their files; several records are numbered."""
    fitted, units = result.fitted, result.units
    tables = {}
    for k, (name, model) in enumerate(models_of(fitted).items()):
        tail, own = f"_{name}" if name else "", units.of_input(k)
        tables[f"step{tail}.csv"] = response_frame(model.step_response(), own.gain, own)
        tables[f"bode{tail}.csv"] = frequency_frame(model.frequency_response(), own)
    several = len(result.records.data) > 1
    for k, record in enumerate(result.records.data):
        number, t = f"_{k + 1}" * several, f"t [{units.time}]"
        used, residuals = fitted.fit.used[k], fitted.fit.residuals[k]
        columns = {t: record.t[used]}
        for i, (name, signal) in enumerate(record.held.items()):
            label = name if record.several else "input"
            columns[f"{label} [{units.of_input(i).input}]"] = signal.at(record.t[used])
        columns[f"measured [{units.output}]"] = record.y[used]
        columns[f"simulated [{units.output}]"] = record.y[used] - residuals
        tables[f"simulation{number}.csv"] = pd.DataFrame(columns)
        tables[f"residuals{number}.csv"] = pd.DataFrame({t: record.t[used], f"residual [{units.output}]": residuals})
    return tables


def response_frame(band: ResponseBand, unit: str, units: Units) -> pd.DataFrame:
    """Return a response over time with its standard error and pointwise band."""
    parts = ("value", "standard_error", "lower", "upper")
    return pd.DataFrame({f"t [{units.time}]": band.t} | {f"{part} [{unit}]": getattr(band, part) for part in parts})


def frequency_frame(band: FrequencyBand, units: Units) -> pd.DataFrame:
    """Return a frequency response as complex numbers, and as gain and phase with their pointwise bands."""
    columns = {f"frequency [rad/{units.time}]": band.frequencies}
    columns |= {f"real [{units.gain}]": band.value.real, f"imaginary [{units.gain}]": band.value.imag}
    for part in ("gain", "gain_error", "gain_lower", "gain_upper"):
        columns[f"{part} [{units.gain}]"] = getattr(band, part)
    for part in ("phase", "phase_error", "phase_lower", "phase_upper"):
        columns[f"{part} [deg]"] = np.rad2deg(getattr(band, part))
    return pd.DataFrame(columns)


def model_code(fit: FittedModel, tool: Tool, time_unit: str, pade: int | None = None) -> tuple[str, str]:
    """Return the name of a file and the code in it that builds a model in another tool, with every digit."""
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
