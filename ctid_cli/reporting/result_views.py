"""How results that are made in Python are shown: each goes with one of the result protocol."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from ctid_cli.errors import UsageError
from ctid_cli.estimators.identification import Identification
from ctid_cli.frequency.base import FrequencyTrack
from ctid_cli.inference.fit import Fit
from ctid_cli.inference.intervals import UncertainValue
from ctid_cli.reporting.document import Result, Section
from ctid_cli.reporting.estimate import PARAMETER_FORMATS, parameter_frame, parameter_object
from ctid_cli.reporting.figures.style import Drawing
from ctid_cli.reporting.fit_result import FitResult
from ctid_cli.reporting.layout import number
from ctid_cli.reporting.measures import parameter_unit
from ctid_cli.reporting.pages.page import sections_of
from ctid_cli.reporting.track_columns import flag_words
from ctid_cli.reporting.track_plot import track_drawing
from ctid_cli.reporting.track_report import tones_block
from ctid_cli.reporting.track_summary import invalid_rows
from ctid_cli.tones.track import Track


def result_of(shown: Any) -> Result:
    """Return the result that shows a fit, an identification or a track."""
    if isinstance(shown, Identification):
        return FitResult.of(shown)
    return TrackView(shown) if isinstance(shown, FrequencyTrack) else SingleFit(shown)


@dataclass(frozen=True, eq=False)
class SingleFit(Result):
    """What one estimator found, without the record that it was made from."""

    fit: Fit

    def sections(self) -> list[Section]:
        """Return the parameters with their uncertainty."""
        fit = self.fit
        note = f"fit {number(fit.fit_percent, 5)} % of {fit.count} samples: {fit.status.value}"
        return [
            Section(frame=parameter_frame(self._parameters()), formats=PARAMETER_FORMATS),
            Section(sentences=[note]),
        ]

    def content(self) -> dict[str, Any]:
        """Return the parameters for JSON."""
        fit = self.fit
        parameters = [parameter_object(item) for item in self._parameters()]
        return {"parameters": parameters, "fit_percent": fit.fit_percent, "status": fit.status.name}

    def to_frame(self) -> pd.DataFrame:
        """Return a row for each parameter."""
        return pd.DataFrame([parameter_object(item) for item in self._parameters()]).set_index("name")

    def plot(self) -> Any:
        """Refuse: there is no record to draw."""
        what = f"a single {type(self.fit).__name__} does not hold the record that it would be drawn with"
        raise UsageError(f"{what}; identify(DelayProfile(...), [record]).plot() does")

    def _parameters(self) -> list[UncertainValue]:
        values, errors, reach = self.fit.parameters, self.fit.standard_errors, self.fit.quantiles
        units = {name: parameter_unit(name, list(values)) for name in values}
        return [
            UncertainValue.symmetric(name, value, errors[name], units[name], reach[name])
            for name, value in values.items()
        ]


@dataclass(frozen=True, eq=False)
class TrackView(Result):
    """Frequencies over time, without the signal that they were found in."""

    track: FrequencyTrack

    def sections(self) -> list[Section]:
        """Return the tones, and how many rows are not valid."""
        from ctid_cli.reporting.layout import Report

        track = _with_columns(self.track)
        tones = sections_of(Report([tones_block(track)]).draw("md"))
        warnings = [f"- {warning}" for warning in invalid_rows(track)]
        return [*tones, *([Section("Warnings:", warnings)] if warnings else [])]

    def content(self) -> dict[str, Any]:
        """Return the columns for JSON."""
        return {str(name): column.tolist() for name, column in self.to_frame().reset_index().items()}

    def to_frame(self) -> pd.DataFrame:
        """Return a row for each instant: frequencies [rad/s] and [Hz], whether all are valid, and flags in words."""
        track = self.track
        tones = range(track.frequencies.shape[1])
        columns: dict[str, Any] = {"t": track.t, **{f"omega_{k + 1}": track.frequencies[:, k] for k in tones}}
        columns |= {f"frequency_{k + 1}_hz": track.frequencies[:, k] / (2.0 * np.pi) for k in tones}
        columns |= {"valid": track.valid, "flags": [flag_words(int(flags)) for flags in track.flags]}
        return pd.DataFrame(columns).set_index("t")

    def plot(self) -> Any:
        """Draw the frequencies over time."""
        return self.drawing().figure()

    def drawing(self) -> Drawing:
        """Return the figure of the frequencies over time."""
        return track_drawing(_with_columns(self.track), 0.0, None, "frequencies")


def _with_columns(track: FrequencyTrack) -> Track:
    """Return a track with the columns of one of a recorded signal."""
    every = float(track.t[1] - track.t[0]) if track.t.size > 1 else 0.0
    return Track.of(track.t, track.frequencies, track.flags, every)
