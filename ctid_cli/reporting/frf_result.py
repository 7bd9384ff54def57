"""The result of ``ctid frf``: a frequency response without a model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from ctid_cli.inference.frequency_response import FrequencyResponse
from ctid_cli.reporting.document import Result, Section
from ctid_cli.reporting.figures.style import Drawing
from ctid_cli.reporting.frf_plot import frf_drawing
from ctid_cli.reporting.layout import picked
from ctid_cli.reporting.records import Records

#: Rows of the printed table, about evenly spaced logarithmically.
ROWS = 15
#: How each method is called in text.
METHODS = {
    "periodic": "mean over periods",
    "local-polynomial": "local polynomials",
    "welch": "averages over segments (Welch)",
}


@dataclass(frozen=True, eq=False)
class FrequencyResponseResult(Result):
    """A frequency response with the records that it was estimated from."""

    schema = "ctid-frf-1"

    found: FrequencyResponse
    records: Records

    def sections(self) -> list[Section]:
        """Return some of the frequencies, and the figure of all."""
        found, units = self.found, self.records.units
        low, high = found.frequencies[[0, -1]]
        span = f"{found.frequencies.size} frequencies from {low:.4g} to {high:.4g} rad/{units.time}"
        head = f"{self.records.line}; frequency response by {METHODS[found.method]}, {span}"
        notes = [f"- {note}" for note in (*found.notes, *self.records.notes)]
        table = self._table()
        formats = dict.fromkeys(table.columns[:4], ".4g") | {"phase [°]": ".1f", "±": ".1f", "coherence": ".3f"}
        formats["distortion"] = ".2g"
        return [Section("", [head, *notes]), Section(frame=table, formats=formats, drawing=self.drawing())]

    def drawing(self) -> Drawing:
        """Return the figure of gain, phase and coherence."""
        return frf_drawing(self.found, self.records.units, self.records.names)

    def _table(self) -> pd.DataFrame:
        """Return the response at a few frequencies, about evenly spaced logarithmically."""
        found, units = self.found, self.records.units
        places = np.geomspace(found.frequencies[0], found.frequencies[-1], ROWS)
        rows = np.unique(np.searchsorted(found.frequencies, places).clip(max=found.frequencies.size - 1))
        low, high = found.gain_band()
        columns = {
            f"frequency [rad/{units.time}]": found.frequencies,
            f"gain [{units.gain}]": np.abs(found.response),
            "95 % low": low,
            "95 % high": high,
            "phase [°]": np.rad2deg(found.phase()),
            "±": np.rad2deg(found.phase_band()),
            "coherence": found.coherence,
        }
        if found.distortion is not None:
            columns["distortion"] = np.sqrt(found.distortion)
        return pd.DataFrame(columns).iloc[rows]

    def to_frame(self) -> pd.DataFrame:
        """Return all frequencies; intervals hold with 95 %."""
        found, unit = self.found, self.records.units.gain
        low, high = found.gain_band()
        columns = {
            f"frequency [rad/{self.records.units.time}]": found.frequencies,
            f"real [{unit}]": found.response.real,
            f"imaginary [{unit}]": found.response.imag,
            f"standard_error [{unit}]": found.standard_error,
            f"gain [{unit}]": np.abs(found.response),
            f"gain_low [{unit}]": low,
            f"gain_high [{unit}]": high,
            "phase [deg]": np.rad2deg(found.phase()),
            "phase_half_width [deg]": np.rad2deg(found.phase_band()),
            "coherence [-]": found.coherence,
            f"hold_bias [{unit}]": found.bias,
        }
        if found.distortion is not None:
            columns[f"distortion [{unit}]"] = np.sqrt(found.distortion)
        # What a fit to the table needs to know of its values.
        told: dict[str, Any] = {
            "freedom [-]": found.freedom,
            f"hold_interval [{self.records.units.time}]": found.interval or np.nan,
        }
        return pd.DataFrame(columns | told | {"correlated [-]": found.method != "periodic"})

    def content(self) -> dict[str, Any]:
        """Return the response for JSON."""
        found = self.found
        low, high = found.gain_band()
        return {
            **self.records.content(),
            **picked(found, ("method", "hold", "frequencies")),
            "real": found.response.real,
            "imaginary": found.response.imag,
            **picked(found, ("standard_error", "freedom", "coherence")),
            "gain_low": low,
            "gain_high": high,
            "phase": np.rad2deg(found.phase()),
            "phase_half_width": np.rad2deg(found.phase_band()),
            "distortion": None if found.distortion is None else np.sqrt(found.distortion),
            "hold_bias": found.bias,
            "notes": [*found.notes, *self.records.notes],
        }
