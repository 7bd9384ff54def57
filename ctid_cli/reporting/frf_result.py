"""Result of ``ctid frf``: a frequency response without a model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.inference.frequency_response import FrequencyResponse
from ctid_cli.inference.units import Units
from ctid_cli.reporting.document import Column, Result, Section, Table
from ctid_cli.reporting.figures.style import Drawing
from ctid_cli.reporting.frf_plot import frf_drawing
from ctid_cli.reporting.layout import picked
from ctid_cli.reporting.records import Records

#: Rows of the printed table, about evenly spaced logarithmically.
ROWS = 15
#: Quantities of the printed table.
PRINTED = (
    *("frequency", "gain", "gain_low", "gain_high", "phase", "phase_half_width"),
    *("coherence", "distortion"),
)
#: Name of each method in text.
METHODS = {
    "periodic": "mean over periods",
    "local-polynomial": "local polynomials",
    "welch": "averages over segments (Welch)",
}


@dataclass(frozen=True, eq=False)
class FrequencyResponseResult(Result):
    """A frequency response with the records from which it was estimated."""

    schema = "ctid-frf-1"

    found: FrequencyResponse
    records: Records

    def sections(self) -> list[Section]:
        """Return some of the frequencies, about evenly spaced logarithmically, and the figure of all."""
        found, units = self.found, self.records.units
        low, high = found.frequencies[[0, -1]]
        span = f"{found.frequencies.size} frequencies from {low:.4g} to {high:.4g} rad/{units.time}"
        head = f"{self.records.line}; frequency response by {METHODS[found.method]}, {span}"
        notes = [f"- {note}" for note in (*found.notes, *self.records.notes)]
        places = np.searchsorted(found.frequencies, np.geomspace(low, high, ROWS)).clip(max=found.frequencies.size - 1)
        values = self._values()
        rows = [{key: own[place] for key, own in values.items()} for place in np.unique(places)]
        printed = [column for column in quantities(units) if column.key in PRINTED]
        return [Section("", [head, *notes]), Section(table=Table.of(rows, printed), drawing=self.drawing())]

    def drawing(self) -> Drawing:
        """Return the figure of gain, phase and coherence."""
        return frf_drawing(self.found, self.records.units, self.records.names)

    def _values(self) -> dict[str, Array]:
        """Return the values at each frequency, by the keys of the quantities, with 95 % intervals."""
        found = self.found
        low, high = found.gain_band()
        values = {
            "frequency": found.frequencies,
            "real": found.response.real,
            "imaginary": found.response.imag,
            "standard_error": found.standard_error,
            "gain": np.abs(found.response),
            "gain_low": low,
            "gain_high": high,
            "phase": np.rad2deg(found.phase()),
            "phase_half_width": np.rad2deg(found.phase_band()),
            "coherence": found.coherence,
            "hold_bias": found.bias,
        }
        return values if found.distortion is None else values | {"distortion": np.sqrt(found.distortion)}

    def main_table(self) -> Table:
        """Return all frequencies, with 95 % intervals."""
        names, found = {column.key: column.name for column in quantities(self.records.units)}, self.found
        # Attributes that a fit to the table uses.
        attributes = {
            "freedom": found.freedom,
            "hold_interval": np.full(found.frequencies.size, found.interval or np.nan),
            "correlated": np.full(found.frequencies.size, found.method != "periodic"),
        }
        return Table.of_columns({names[key]: values for key, values in (self._values() | attributes).items()})

    def content(self) -> dict[str, Any]:
        """Return the response for JSON."""
        values, head = self._values(), picked(self.found, ("method", "hold", "frequencies", "freedom"))
        del values["frequency"]
        notes = [*self.found.notes, *self.records.notes]
        return {**self.records.content(), **head, "distortion": None, **values, "notes": notes}


def quantities(units: Units) -> tuple[Column, ...]:
    """Return the quantities of a response at each frequency."""
    gain = units.gain if units.is_known(units.gain) else ""
    return (
        Column("frequency", "", ".4g", f"rad/{units.time}"),
        Column("real", unit=gain),
        Column("imaginary", unit=gain),
        Column("standard_error", unit=gain),
        Column("gain", "", ".4g", gain),
        Column("gain_low", "95 % low", ".4g", gain),
        Column("gain_high", "95 % high", ".4g", gain),
        Column("phase", "phase [°]", ".1f", "deg"),
        Column("phase_half_width", "±", ".1f", "deg"),
        Column("coherence", "coherence", ".3f", "-"),
        Column("hold_bias", unit=gain),
        Column("distortion", "distortion", ".2g", gain),
        Column("freedom", unit="-"),
        Column("hold_interval", unit=units.time),
        Column("correlated", unit="-"),
    )
