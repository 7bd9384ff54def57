"""What ``ctid model`` answers: responses of stored fits, and the fits on another record, as text, JSON and files."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.canonical import plain
from ctid_cli.errors import DataError, UsageError
from ctid_cli.estimators.model_comparison import ModelOnRecord
from ctid_cli.inference.fitted_model import FittedModel
from ctid_cli.inference.model_responses import FrequencyBand, ResponseBand
from ctid_cli.inference.residual_tests import ResidualTests
from ctid_cli.reporting.estimate import Units
from ctid_cli.reporting.layout import Table, number, percent, picked
from ctid_cli.signals.measurement import MeasuredInput, Measurement, open_table, read_measurement
from ctid_cli.storage.fit_file import read_fit
from ctid_cli.text import listed, wrapped

#: Rows of a printed table of a response.
ROWS = 12
#: What is told of the tests of residuals.
VERDICTS = ("white", "whiteness_p_value", "uncorrelated", "cross_p_value")


@dataclass(frozen=True, eq=False)
class NamedFit:
    """A stored fit with the name that it goes by beside others."""

    name: str
    path: Path
    fit: FittedModel
    units: Units
    hold: Any
    columns: Mapping[str, str]


def named_fits(files: Sequence[Path]) -> list[NamedFit]:
    """Stored fits, each with as much of its path for a name as tells it from the others."""
    found = []
    for file, name in zip(files, short_names(files), strict=True):
        stored = read_fit(file)
        content = stored.content
        units, columns = Units(**content["units"]), content["records"][0]["columns"]
        found.append(NamedFit(name, file, stored.result, units, content["settings"]["hold"], columns))
        require_units(file.name, found[0], units.time, units.input, units.output, "the models")
    return found


def short_names(files: Sequence[Path]) -> list[str]:
    """File names where they differ, with folders where they do not."""
    # A file that is called fit.json, as most are, goes by its folder.
    parts = [file.parts[:-1] if file.name == "fit.json" and file.parts[:-1] else file.parts for file in files]
    for depth in range(1, 1 + max(map(len, parts))):
        names = ["/".join(each[-depth:]).removesuffix(".json") for each in parts]
        if len(set(names)) == len(names):
            return names
    twice = next(file for file in files if files.count(file) > 1)
    raise UsageError(f"{twice} is given twice; a model is compared with others")


def require_units(
    where: str, model: NamedFit, time: str | None, input: str | None, output: str | None, what: str = "the model"
) -> None:
    """Refuse signals in other units than a model has; a label that is missing contradicts nothing."""
    given = {"time": time, "input": input, "output": output}
    for (role, unit), default in zip(given.items(), ("s", "in", "out"), strict=True):
        own = getattr(model.units, role)
        unlabelled = role != "time" and default in (own, unit)
        if unit is not None and unit != own and not unlabelled:
            verb = "is" if what == "the model" else "are"
            raise DataError(f"{where}: the {role} is in {unit}, and {what} {verb} in {own}; convert one of them")


def record_for(
    models: Sequence[NamedFit],
    file: Path,
    hold: Any,
    time: str | None,
    input: str | None,
    output: str | None,
    start: float | None = None,
    stop: float | None = None,
) -> Measurement:
    """A record to look at models with: the columns of their own record where the file has them and none are named."""
    names: dict[str, Any]
    own, names = models[0].columns, {"time": time, "input": input, "output": output}
    if not any(names.values()) and set(own.values()) <= set(open_table(file).names):
        names = {role: own[role] for role in names}
    found = read_measurement(file, **names, hold=hold or models[0].hold, start=start, stop=stop)
    require_units(found.record.name, models[0], found.time_unit, found.input_unit, found.output_unit)
    return found


def require_input(models: Sequence[NamedFit], found: MeasuredInput, where: str) -> None:
    """Refuse an input in other units, or one that ends before a model has answered."""
    require_units(where, models[0], found.time_unit, found.input_unit, None)
    span = float(np.ptp(found.signal.t))
    for model in models:
        delay = model.fit._estimated().parametric.model.delay
        if span <= delay:
            unit = model.units.time
            text = f"the input spans {span:.6g} {unit}, and the model's delay is {delay:.6g} {unit}"
            raise DataError(f"{where}: {text}; nothing of the answer would be seen")


# --- tables ----------------------------------------------------------------------------------------


def csv_bytes(columns: Mapping[str, Array]) -> bytes:
    """A file of columns with all their digits."""
    import pandas as pd

    return pd.DataFrame(dict(columns)).to_csv(index=False, lineterminator="\n").encode()


def response_columns(
    models: Sequence[NamedFit], bands: Sequence[ResponseBand], input: Array | None = None
) -> dict[str, Array]:
    """Columns of ``step.csv`` and, with an input, ``simulation.csv``; those of several models carry their names."""
    units = models[0].units
    unit = units.gain if input is None else units.output
    columns = {f"t [{units.time}]": bands[0].t} | ({} if input is None else {f"input [{units.input}]": input})
    for model, band in zip(models, bands, strict=True):
        tail = f" {model.name}" if len(models) > 1 else ""
        for part in ("value", "standard_error", "lower", "upper"):
            columns[f"{part}{tail} [{unit}]"] = getattr(band, part)
    return columns


def frequency_columns(models: Sequence[NamedFit], bands: Sequence[FrequencyBand]) -> dict[str, Array]:
    """Columns of ``bode.csv``."""
    units = models[0].units
    columns = {f"frequency [rad/{units.time}]": bands[0].frequencies}
    for model, band in zip(models, bands, strict=True):
        tail = f" {model.name}" if len(models) > 1 else ""
        columns[f"real{tail} [{units.gain}]"] = band.value.real
        columns[f"imaginary{tail} [{units.gain}]"] = band.value.imag
        for part in ("gain", "gain_error", "gain_lower", "gain_upper"):
            columns[f"{part}{tail} [{units.gain}]"] = getattr(band, part)
        for part in ("phase", "phase_error", "phase_lower", "phase_upper"):
            columns[f"{part}{tail} [deg]"] = np.rad2deg(getattr(band, part))
    return columns


def response_tables(columns: Mapping[str, Array], models: Sequence[NamedFit], *, logarithmic: bool = False) -> str:
    """Some rows of a response, a table for each model; standard errors and complex values are in the file."""
    first = next(iter(columns.values()))
    places = (np.geomspace if logarithmic else np.linspace)(first[0], first[-1], ROWS)
    rows = np.unique(np.searchsorted(first, places).clip(max=first.size - 1))
    blocks = []
    for model in models:
        mark = f" {model.name} ["
        own = [key for key in columns if len(models) == 1 or mark in key]
        own = [key for key in own if key.startswith(("input", "value", "lower", "upper", "gain", "phase"))]
        shown = [next(iter(columns)), *(key for key in own if "_error" not in key)]
        header = [key.replace(mark, " [").replace("_lower", " low").replace("_upper", " high") for key in shown]
        cells = [[number(float(columns[key][k]), 5) for key in shown] for k in rows]
        title = [f"{model.name}:"] if len(models) > 1 else []
        blocks.append("\n".join([*title, Table(header, cells, "r" * len(header)).draw()]))
    return "\n\n".join(blocks)


def response_object(models: Sequence[NamedFit], columns: Mapping[str, Array], level: float) -> dict[str, Any]:
    """A response for ``--json``: the columns of its file."""
    named = {model.name: str(model.path) for model in models}
    content = {"models": named, "units": asdict(models[0].units), "level": level, "columns": dict(columns)}
    return dict(plain(content))


# --- models on a record ----------------------------------------------------------------------------


def comparison_object(
    models: Sequence[NamedFit], measurement: Measurement, found: Sequence[ModelOnRecord]
) -> dict[str, Any]:
    """Models on a record for ``--json``."""
    rows = [
        {
            "name": model.name,
            "file": str(model.path),
            **picked(one, ("fit_percent", "r2", "rms")),
            "samples": one.count,
            **picked(one, ("initial_state", "offset")),
            **(dict.fromkeys(VERDICTS) if one.tests is None else picked(one.tests, VERDICTS)),
        }
        for model, one in zip(models, found, strict=True)
    ]
    return dict(plain({"record": measurement.record.name, "units": asdict(models[0].units), "models": rows}))


def comparison_table(models: Sequence[NamedFit], found: Sequence[ModelOnRecord]) -> Table:
    """Models on a record, the best fit first."""
    units = models[0].units
    header = ["model", "samples", "fit %", "R2", f"rms [{units.output}]", "white", "p", "independent of the input", "p"]
    header += ["initial state", "offset"]
    rows = []
    for k in np.argsort([-one.fit_percent for one in found], kind="stable"):
        one, test = found[k], found[k].tests
        verdicts = ["-"] * 4
        if test is not None:
            verdicts = [_yes(test.white, test.whiteness_p_value), number(test.whiteness_p_value, 2)]
            verdicts += [_yes(test.uncorrelated, test.cross_p_value), number(test.cross_p_value, 2)]
        numbers = [percent(one.fit_percent, 10**6), number(one.r2, 5), number(one.rms, 4)]
        rows.append([models[k].name, str(one.count), *numbers, *verdicts, one.initial_state, one.offset])
    return Table(header, rows, "lrrrrlrlrll")


def _yes(passed: bool, p_value: float) -> str:
    return "-" if np.isnan(p_value) else "yes" if passed else "no"


def comparison_columns(found: Sequence[ModelOnRecord], models: Sequence[NamedFit], record: Any) -> dict[str, Array]:
    """Columns of ``comparison.csv``: what was measured, and what each model answers, empty where it was not used."""
    units = models[0].units
    columns = {f"t [{units.time}]": record.t, f"measured [{units.output}]": record.y}
    for model, one in zip(models, found, strict=True):
        tail = f" {model.name}" if len(models) > 1 else ""
        full = np.full(record.t.size, np.nan)
        full[np.searchsorted(record.t, one.t)] = one.simulated
        columns[f"simulated{tail} [{units.output}]"] = full
    return columns


def residual_columns(one: ModelOnRecord, units: Units) -> dict[str, Array]:
    """Columns of ``residuals.csv``."""
    return {f"t [{units.time}]": one.t, f"residual [{units.output}]": one.residuals}


def residual_object(model: NamedFit, measurement: Measurement, one: ModelOnRecord) -> dict[str, Any]:
    """Residuals of a model on a record for ``--json``."""
    content = comparison_object([model], measurement, [one])
    test = one.tests
    correlation = test and {"level": test.level, **_correlations(test), "sentence": test.sentence}
    return {**content, **dict(plain({"correlation": correlation}))}


def _correlations(test: ResidualTests) -> dict[str, dict[str, Any]]:
    """Lags, values and bands of the correlations of residuals."""
    found = {}
    for name, first in (("autocorrelation", 1), ("cross_correlation", -test.lags)):
        values, band = getattr(test, name), getattr(test, f"{name}_band")
        found[name] = {"lags": np.arange(first, test.lags + 1), "values": values, "band": band}
    return found


def residual_text(model: NamedFit, measurement: Measurement, one: ModelOnRecord) -> str:
    """Residuals of a model on a record for people."""
    units, test = model.units, one.tests
    head = f"{model.name} on {measurement.record.name}: {one.count} samples, fit {percent(one.fit_percent, 10**6)} %, "
    lines = [wrapped(f"{head}residuals of {number(one.rms, 4)} {units.output} (rms)")]
    if test is None:
        return "\n".join([*lines, "There are too few samples to test the residuals."])
    for name, found in _correlations(test).items():
        what = "with the input" if name == "cross_correlation" else name
        lags, values, band = found.values()
        if np.isfinite(band) and np.isfinite(values).all():
            outside = np.abs(values) > band
            largest = int(np.argmax(np.abs(values)))
            text = f"{what:16} {outside.sum()} of {lags.size} lags outside -+{band:.3g} ({100 * test.level:.3g} % band)"
            lines.append(f"{text}, largest {values[largest]:.3g} at lag {lags[largest]}")
    return "\n".join([*lines, wrapped(test.sentence)])


def names_of(models: Sequence[NamedFit]) -> str:
    """All models in a title."""
    return listed([model.name for model in models])
