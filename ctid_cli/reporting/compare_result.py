"""Result of ``ctid compare``: stored fits on the same samples of one record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ctid_cli.errors import UsageError
from ctid_cli.estimators.model_comparison import ModelOnRecord
from ctid_cli.inference.units import Units
from ctid_cli.reporting.document import Column, Result, Section, Table
from ctid_cli.reporting.figures.style import DARK, LIGHT, Drawing, look, name_axes, outline, plain
from ctid_cli.reporting.fit_plot import curve
from ctid_cli.reporting.layout import picked
from ctid_cli.signals.measurement import Measurement
from ctid_cli.storage.fit_file import StoredFit
from ctid_cli.text import probability

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Reported fields of the tests of residuals.
TESTS = (("white", "whiteness_p_value"), ("uncorrelated", "cross_p_value"))
VERDICTS = [key for pair in TESTS for key in pair]
#: Meaning of the columns of the table.
MEANING = (
    "fit: 100 (1 - ||y - x|| / ||y - mean y||) of the simulated output x. white, independent: whether tests of the "
    "residuals accept that they are white, and independent of the input, with their p-values."
)


def short_names(files: Sequence[Path]) -> list[str]:
    """Return file names if they differ, otherwise with folders."""
    # Most fits are called fit.json, and named by their folder.
    parts = [file.parts[:-1] if file.name == "fit.json" and file.parts[:-1] else file.parts for file in files]
    for depth in range(1, 1 + max(map(len, parts))):
        names = ["/".join(each[-depth:]).removesuffix(".json") for each in parts]
        if len(set(names)) == len(names):
            return names
    twice = next(file for file in files if files.count(file) > 1)
    raise UsageError(f"{twice} is given twice; a model is compared with others")


@dataclass(frozen=True, eq=False)
class ModelComparison(Result):
    """Stored fits on the same samples of one record."""

    schema = "ctid-compare-1"

    fits: Sequence[StoredFit]
    measurement: Measurement
    found: Sequence[ModelOnRecord]

    @property
    def units(self) -> Units:
        """Units that all models share."""
        return self.fits[0].units

    @property
    def names(self) -> list[str]:
        """Names that distinguish the fits."""
        return short_names([fit.path for fit in self.fits])

    def sections(self) -> list[Section]:
        """Return the models, the best fit first, and the samples on which they are compared."""
        record, one, unit = self.measurement.record, self.found[0], self.units
        used = "all" if one.count == record.n_samples else f"{one.count} of"
        samples = f"{record.name}: all models use {used} {record.n_samples} samples, from {one.t[0]:.6g} to "
        rows = [row | {test: _outcome(row[test], row[p]) for test, p in TESTS} for row in self._rows()]
        columns = (
            Column("name", "model"),
            Column("fit_percent", "fit %", ".2f"),
            Column("r2", "R2", ".5g"),
            Column("rms", form=".4g", unit=unit.output if unit.is_known(unit.output) else ""),
            Column("white"),
            Column("uncorrelated", "independent"),
            Column("initial_state", "initial state"),
            Column("offset"),
        )
        marks = [f"{row['name']}: {' '.join(row['marks'])}" for row in rows if row["marks"]]
        best_first = sorted(rows, key=lambda row: -row["fit_percent"])
        return [
            Section(sentences=[f"{samples}{one.t[-1]:.6g} {unit.time}."]),
            Section(table=Table.of(best_first, columns), notes=[*marks, MEANING], drawing=self.drawing()),
        ]

    def _rows(self) -> list[dict[str, Any]]:
        """Return a row of the table for each model."""
        return [
            {
                "name": name,
                "file": str(fit.path),
                **picked(one, ("fit_percent", "r2", "rms")),
                "samples": one.count,
                "marks": fit.result.marks(self.units.time),
                **picked(one, ("initial_state", "offset")),
                **(dict.fromkeys(VERDICTS) if one.tests is None else picked(one.tests, VERDICTS)),
            }
            for name, fit, one in zip(self.names, self.fits, self.found, strict=True)
        ]

    def main_table(self) -> Table:
        """Return the measured output, and that of each model, at common samples."""
        units, first = self.units, self.found[0]
        columns = {f"t [{units.time}]": first.t, units.label("measured", units.output): first.measured}
        for name, one in zip(self.names, self.found, strict=True):
            columns[units.label(f"simulated {name}", units.output)] = one.simulated
        return Table.of_columns(columns)

    def content(self) -> dict[str, Any]:
        """Return the comparison for JSON."""
        t = self.found[0].t
        used = {"count": t.size, "first": float(t[0]), "last": float(t[-1])}
        return {
            "record": self.measurement.record.name,
            "units": asdict(self.units),
            "samples": used,
            "models": self._rows(),
        }

    def drawing(self) -> Drawing:
        """Return the figure of the outputs above the residuals."""
        return Drawing(8.0, 5.0, self._draw)

    def _draw(self, figure: Figure) -> None:
        units, record, names = self.units, self.measurement.record, self.names
        upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[1.8, 1.0])
        upper.plot(*outline(record.t, record.y), color=LIGHT, linewidth=2.4, label="measured")
        for k in np.argsort([-one.fit_percent for one in self.found], kind="stable").tolist():
            one, style = self.found[k], {**look(k), "marker": "none", "linewidth": 1.2}
            used = np.searchsorted(record.t, one.t)
            label = f"{plain(names[k])}: {one.fit_percent:.4g} %"
            upper.plot(*curve(record.t, used, one.simulated), label=label, **style)
            lower.plot(*curve(record.t, used, one.residuals), **style | {"linewidth": 0.7})
        lower.axhline(0.0, color=DARK, linewidth=0.6)
        name_axes(upper, y=units.column(self.measurement, "output"), legend="best")
        name_axes(lower, units.column(self.measurement, "time"), units.label("residual", units.output))
        upper.margins(x=0.0)


def _outcome(passed: bool | None, p_value: float | None) -> str | None:
    """Return whether a test is passed, with its p-value; None if it could not be made."""
    if p_value is None or np.isnan(p_value):
        return None
    return f"{'yes' if passed else 'no'} ({probability(p_value)})"
