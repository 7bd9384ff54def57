"""Presentation of results that are made in Python, by the result protocol."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ctid_cli.errors import UsageError
from ctid_cli.estimators.frequency_domain import FrequencyDomainFit
from ctid_cli.estimators.identification import Identification
from ctid_cli.frequency.base import FrequencyTrack
from ctid_cli.frequency.flags import flag_names
from ctid_cli.inference.fit import Fit
from ctid_cli.inference.intervals import UncertainValue
from ctid_cli.reporting.document import Result, Section, Table
from ctid_cli.reporting.estimate import PARAMETER, parameter_rows
from ctid_cli.reporting.fit_result import FitResult
from ctid_cli.reporting.frequency_fit import FrequencyFitResult
from ctid_cli.reporting.layout import number
from ctid_cli.reporting.measures import parameter_unit
from ctid_cli.reporting.track_result import TURN, TrackResult
from ctid_cli.tones.track import Track


def result_of(shown: Any) -> Result:
    """Return the result that shows a fit, an identification or a track."""
    if isinstance(shown, Identification):
        kind = FrequencyFitResult if isinstance(shown.fit, FrequencyDomainFit) else FitResult
        return kind.of(shown)
    if isinstance(shown, Track):
        return TrackResult(shown)
    return OnlineTrackResult.of(shown) if isinstance(shown, FrequencyTrack) else SingleFit(shown)


@dataclass(frozen=True, eq=False)
class SingleFit(Result):
    """Estimate of one estimator, without its record."""

    fit: Fit

    def sections(self) -> list[Section]:
        """Return the parameters with their uncertainty."""
        fit = self.fit
        note = f"fit {number(fit.fit_percent, 5)} % of {fit.count} samples: {fit.status.value}"
        return [
            Section(table=Table.of(self._parameters(), PARAMETER)),
            Section(sentences=[note]),
        ]

    def content(self) -> dict[str, Any]:
        """Return the parameters for JSON."""
        fit = self.fit
        parameters = parameter_rows(self._parameters())
        return {"parameters": parameters, "fit_percent": fit.fit_percent, "status": fit.status.name}

    def main_table(self) -> Table:
        """Return a row for each parameter."""
        return Table.of_rows(parameter_rows(self._parameters()), is_named=True)

    def plot(self) -> Any:
        """Refuse to plot: there is no record to draw."""
        what = f"a single {type(self.fit).__name__} does not hold the record that it would be drawn with"
        raise UsageError(f"{what}; identify(record).plot() does")

    def _parameters(self) -> list[UncertainValue]:
        values, errors, reach = self.fit.parameters, self.fit.standard_errors, self.fit.quantiles
        units = {name: parameter_unit(name, list(values)) for name in values}
        return [
            UncertainValue.symmetric(name, value, errors[name], units[name], reach[name])
            for name, value in values.items()
        ]


class OnlineTrackResult(TrackResult):
    """Frequencies over time, of an estimator without amplitudes and errors."""

    @classmethod
    def of(cls, track: FrequencyTrack) -> OnlineTrackResult:
        """Return the result of a track that has no amplitudes and errors."""
        every = float(track.t[1] - track.t[0]) if track.t.size > 1 else 0.0
        return cls(Track.of(track.t, track.frequencies, track.flags, every))

    def main_table(self) -> Table:
        """Return a row for each instant: frequencies [rad/s] and [Hz], whether all are valid, and flags by name."""
        track = self.track
        names = [f"omega_{k + 1}" for k in range(track.omega.shape[1])]
        columns: dict[str, Any] = {"t": track.t, **dict(zip(names, track.omega.T, strict=True))}
        columns |= {f"frequency_{k + 1}_hz": column / TURN for k, column in enumerate(track.omega.T)}
        flags = np.bitwise_or.reduce(track.flags, axis=1)
        columns |= {"valid": track.valid.all(axis=1), "flags": flag_names(flags)}
        return Table.of_columns(columns, is_named=True)
