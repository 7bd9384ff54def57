"""The result of ``ctid compare``: stored fits on the same samples of one record."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from ctid_cli.errors import DataError, UsageError
from ctid_cli.estimators.model_comparison import ModelOnRecord
from ctid_cli.inference.fitted_model import FittedModel
from ctid_cli.reporting.document import Result, Section
from ctid_cli.reporting.estimate import Units
from ctid_cli.reporting.figures.style import DARK, LIGHT, Drawing, look, outline, plain
from ctid_cli.reporting.fit_plot import curve
from ctid_cli.reporting.layout import picked
from ctid_cli.signals.measurement import Measurement
from ctid_cli.signals.table import split_header
from ctid_cli.storage.fit_file import read_fit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: What is told of the tests of residuals.
VERDICTS = ("white", "whiteness_p_value", "uncorrelated", "cross_p_value")
#: What the columns of the table mean.
MEANING = (
    "fit: 100 (1 - ||y - x|| / ||y - mean y||) of the simulated output x. white, independent: whether the residuals "
    "are white, and independent of the input; p is the probability of residuals farther from that."
)


@dataclass(frozen=True, eq=False)
class NamedFit:
    """A stored fit with the name that tells it from others."""

    name: str
    path: Path
    fit: FittedModel
    units: Units
    hold: Any
    columns: Mapping[str, Any]


def named_fits(files: Sequence[Path]) -> list[NamedFit]:
    """Read stored fits; all must have the same units."""
    found = []
    for file, name in zip(files, short_names(files), strict=True):
        stored = read_fit(file)
        content = stored.content
        units, columns = Units(**content["units"]), content["records"][0]["columns"]
        found.append(NamedFit(name, file, stored.result, units, content["settings"]["hold"], columns))
        require_units(file.name, found[0], units.time, units.input, units.output, "the models")
    return found


def short_names(files: Sequence[Path]) -> list[str]:
    """Return file names where they differ, with folders where they do not."""
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


@dataclass(frozen=True, eq=False)
class ModelComparison(Result):
    """Stored fits on the same samples of one record."""

    schema = "ctid-compare-1"

    models: Sequence[NamedFit]
    measurement: Measurement
    found: Sequence[ModelOnRecord]

    def sections(self) -> list[Section]:
        """Return the models, the best fit first, and the samples that they are compared on."""
        record, one, unit = self.measurement.record, self.found[0], self.models[0].units
        every = "all" if one.count == record.n_samples else f"{one.count} of"
        samples = (
            f"{record.name}: {every} {record.n_samples} samples, from {one.t[0]:.6g} to {one.t[-1]:.6g} {unit.time}"
        )
        formats = {"fit %": ".2f", "R2": ".5g", f"rms [{unit.output}]": ".4g"}
        formats |= dict.fromkeys(("p, white", "p, independent"), ".2g")
        return [
            Section(sentences=[f"{samples}, the same for all models."]),
            Section(frame=self._table(), formats=formats, notes=[MEANING], drawing=self.drawing()),
        ]

    def _table(self) -> pd.DataFrame:
        rows = []
        for model, one in zip(self.models, self.found, strict=True):
            test = one.tests
            rows.append(
                {
                    "model": model.name,
                    "fit %": one.fit_percent,
                    "R2": one.r2,
                    f"rms [{model.units.output}]": one.rms,
                    "white": None if test is None else _verdict(test.white, test.whiteness_p_value),
                    "p, white": test and test.whiteness_p_value,
                    "independent": None if test is None else _verdict(test.uncorrelated, test.cross_p_value),
                    "p, independent": test and test.cross_p_value,
                    "initial state": one.initial_state,
                    "offset": one.offset,
                }
            )
        return pd.DataFrame(rows).sort_values("fit %", ascending=False, kind="stable")

    def to_frame(self) -> pd.DataFrame:
        """Return the measured output, and that of each model, at the samples that all of them have."""
        units, first = self.models[0].units, self.found[0]
        columns = {f"t [{units.time}]": first.t, f"measured [{units.output}]": first.measured}
        for model, one in zip(self.models, self.found, strict=True):
            columns[f"simulated {model.name} [{units.output}]"] = one.simulated
        return pd.DataFrame(columns)

    def content(self) -> dict[str, Any]:
        """Return the comparison for JSON."""
        rows = [
            {
                "name": model.name,
                "file": str(model.path),
                **picked(one, ("fit_percent", "r2", "rms")),
                "samples": one.count,
                **picked(one, ("initial_state", "offset")),
                **(dict.fromkeys(VERDICTS) if one.tests is None else picked(one.tests, VERDICTS)),
            }
            for model, one in zip(self.models, self.found, strict=True)
        ]
        t = self.found[0].t
        used = {"count": t.size, "first": float(t[0]), "last": float(t[-1])}
        units = asdict(self.models[0].units)
        return {"record": self.measurement.record.name, "units": units, "samples": used, "models": rows}

    def drawing(self) -> Drawing:
        """Return the figure of the outputs above the residuals."""
        units, record = self.models[0].units, self.measurement.record

        def draw(figure: Figure) -> None:
            upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[1.8, 1.0])
            upper.plot(*outline(record.t, record.y), color=LIGHT, linewidth=2.4, label="measured")
            for k in np.argsort([-one.fit_percent for one in self.found], kind="stable").tolist():
                one, style = self.found[k], {**look(k), "marker": "none", "linewidth": 1.2}
                used = np.searchsorted(record.t, one.t)
                label = f"{plain(self.models[k].name)}: {one.fit_percent:.4g} %"
                upper.plot(*curve(record.t, used, one.simulated), label=label, **style)
                lower.plot(*curve(record.t, used, one.residuals), **style | {"linewidth": 0.7})
            lower.axhline(0.0, color=DARK, linewidth=0.6)
            upper.set_ylabel(f"{plain(split_header(self.measurement.output)[0])} [{plain(units.output)}]")
            lower.set_ylabel(f"residual [{plain(units.output)}]")
            lower.set_xlabel(f"{plain(split_header(self.measurement.time)[0])} [{plain(units.time)}]")
            upper.margins(x=0.0)
            upper.legend(loc="best", fontsize=8)

        return Drawing(8.0, 5.0, draw)


def _verdict(passed: bool, p_value: float) -> bool | None:
    """Return whether a test is passed, None where it could not be made."""
    return None if np.isnan(p_value) else passed
