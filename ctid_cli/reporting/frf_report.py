"""What ``ctid frf`` answers: a frequency response without a model as text, as an object for JSON, and as a file."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.canonical import plain
from ctid_cli.inference.frequency_response import FrequencyResponse
from ctid_cli.reporting.estimate import Units
from ctid_cli.reporting.identification_report import notes_of, records_line, records_object
from ctid_cli.reporting.layout import Report, Table, number, picked
from ctid_cli.signals.measurement import Measurement
from ctid_cli.text import wrapped

#: Rows of the printed table, about evenly spaced logarithmically.
ROWS = 15
#: How each method is called in text.
METHODS = {
    "periodic": "mean over periods",
    "local-polynomial": "local polynomials",
    "welch": "averages over segments (Welch)",
}


def frf_columns(found: FrequencyResponse, units: Units) -> dict[str, Array]:
    """Columns of ``frf.csv`` by their headers; intervals hold with 95 %."""
    low, high = found.gain_band()
    columns = {
        f"frequency [rad/{units.time}]": found.frequencies,
        f"real [{units.gain}]": found.response.real,
        f"imaginary [{units.gain}]": found.response.imag,
        f"standard_error [{units.gain}]": found.standard_error,
        f"gain [{units.gain}]": np.abs(found.response),
        f"gain_low [{units.gain}]": low,
        f"gain_high [{units.gain}]": high,
        "phase [deg]": np.rad2deg(found.phase()),
        "phase_half_width [deg]": np.rad2deg(found.phase_band()),
        "coherence [-]": found.coherence,
        f"hold_bias [{units.gain}]": found.bias,
    }
    if found.distortion is not None:
        columns[f"distortion [{units.gain}]"] = np.sqrt(found.distortion)
    return columns


def frf_object(found: FrequencyResponse, measurements: Sequence[Measurement], units: Units) -> dict[str, Any]:
    """A frequency response for ``ctid frf --json``."""
    low, high = found.gain_band()
    content = {
        **records_object(measurements, units),
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
        "notes": [*found.notes, *notes_of(measurements)],
    }
    return dict(plain(content))


def frf_text(found: FrequencyResponse, measurements: Sequence[Measurement], units: Units) -> str:
    """A frequency response for people."""
    low, high = found.frequencies[[0, -1]]
    span = f"{found.frequencies.size} frequencies from {low:.4g} to {high:.4g} rad/{units.time}"
    head = f"{records_line(measurements)}; frequency response by {METHODS[found.method]}, {span}"
    notes = [wrapped(f"- {note}", hanging="  ") for note in (*found.notes, *notes_of(measurements))]
    return "\n".join([wrapped(head), *notes, "", Report([[_table(found, units)]]).draw()])


def _table(found: FrequencyResponse, units: Units) -> Table:
    """Some of the frequencies."""
    places = np.geomspace(found.frequencies[0], found.frequencies[-1], ROWS)
    rows = np.unique(np.searchsorted(found.frequencies, places).clip(max=found.frequencies.size - 1))
    gain, phase, half = np.abs(found.response), np.rad2deg(found.phase()), np.rad2deg(found.phase_band())
    low, high = found.gain_band()
    header = [f"[rad/{units.time}]", f"gain [{units.gain}]", "95 % low", "95 % high", "phase [°]", "±", "coherence"]
    cells = [
        [
            *(number(float(values[k]), 4) for values in (found.frequencies, gain, low, high)),
            *((f"{phase[k]:.1f}", f"{half[k]:.1f}") if np.isfinite(phase[k]) else ("unknown", "")),
            f"{found.coherence[k]:.3f}",
        ]
        for k in rows
    ]
    if found.distortion is not None:
        header.append("distortion")
        for row, k in zip(cells, rows, strict=True):
            row.append(number(float(np.sqrt(found.distortion[k])), 2))
    return Table(header, cells, "r" * len(header))
