"""The result of ``ctid fit`` on a frequency response, and its figure."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from ctid_cli.canonical import plain as as_plain
from ctid_cli.estimators.frequency_domain import FrequencyDomainFit
from ctid_cli.estimators.identification import Identification
from ctid_cli.reporting.document import Section
from ctid_cli.reporting.estimate import PARAMETER_FORMATS, Units, parameter_frame
from ctid_cli.reporting.figures.style import BAND, DARK, MIDDLE, Drawing, plain
from ctid_cli.reporting.fit_content import fit_content, parameters_of
from ctid_cli.reporting.fit_result import FitResult, form_of, search_lines, structure_text
from ctid_cli.reporting.frf_plot import decibels, name_axes
from ctid_cli.reporting.layout import number
from ctid_cli.reporting.records import Records
from ctid_cli.text import count

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: What lines weigh by where they have no standard errors.
WEIGHTS = {
    "inverse": "reciprocal of the gain, for relative errors",
    "inverse-sqrt": "reciprocal of the square root of the gain",
    "none": "the same for all lines",
}
FIT_DEFINITION = "100 (1 - ||W (G - M)|| / ||W G||)"


@dataclass(frozen=True, eq=False)
class FrequencyFitResult(FitResult):
    """A fit to a frequency response."""

    @classmethod
    def of(cls, fitted: Identification) -> FrequencyFitResult:
        """Return the result of a fit."""
        return cls(fitted, Records([]))

    @property
    def fit(self) -> FrequencyDomainFit:
        """The estimate."""
        assert isinstance(self.fitted.fit, FrequencyDomainFit)
        return self.fitted.fit

    @property
    def units(self) -> Units:
        """Units of the data."""
        time, output, input_ = self.fit.data.units
        return Units(time, input_, output)

    def data(self) -> Section:
        """Return the data, and what reading them has shown."""
        data, time = self.fit.data, self.units.time
        low, high = data.frequencies[[0, -1]]
        line = (
            f"{data.name or 'frequency response'}: {count(data.frequencies.size, 'line')} from {low:.6g} to {high:.6g}"
        )
        return Section(sentences=[f"{line} rad/{time}", *data.notes])

    def settings(self) -> Iterator[tuple[str, str]]:
        """Return what was estimated, and how the data were taken."""
        options, data, time = self.fitted.options, self.fit.data, self.units.time
        low, high = options.delay_bounds
        searched = f"searched from {low:g} to {high:g} {time}" if low < high else f"known, {low:g} {time}"
        yield "model", f"{structure_text(options)}; delay {searched}"
        if options.fixed:
            yield "known", ", ".join(f"{one.name} = {one.value:.6g}" for one in options.fixed) + " (--fix)"
        sampled = f"those of samples at intervals of {data.interval:g} {time}, input constant between them"
        yield "values", sampled if data.interval else "G(jw)"
        if data.standard_error is None:
            yield "weights", f"{WEIGHTS[data.weight]} (--weight {data.weight})"
        else:
            yield "weights", "reciprocal of standard_error"

    def parameters(self) -> Section:
        """Return the parameters with their uncertainty."""
        frame = parameter_frame(parameters_of(self.fitted, self.units))
        return Section(frame=frame, formats=PARAMETER_FORMATS, notes=[f"{self._errors()} {form_of(self.fit)}"])

    def _errors(self) -> str:
        """What the standard errors hold for."""
        fit, law = self.fit, self.fitted.uncertainty
        if not self.fitted.answer.seen:
            return "There are no standard errors, as the values are not seen to be anything but noise."
        if not np.isfinite(np.diag(law.covariance)).any():
            return "There are no standard errors."
        if law.kind == "robust":
            why = "the lines share samples" if fit.data.correlated else "the residuals of neighbouring lines are"
            text = f"Standard errors are those for correlated errors of neighbouring lines, as {why}"
        elif fit.errors_known:
            text = "Standard errors are from those of the data, which the residuals agree with"
        else:
            text = "Standard errors are from the residuals of the lines, taken as independent"
        return f"{text}; intervals are estimate -+ {law.quantile(np.zeros(1)):.3g} of them."

    def quality(self) -> Iterator[tuple[str, str]]:
        """Return what tells how good the fit is."""
        fit, criteria = self.fit, self.fitted.criteria
        yield "fit", f"{number(fit.fit_percent, 5)} % = {FIT_DEFINITION}"
        yield "", "G values, M model, W weights"
        yield "cost", f"{number(fit.cost)}, mean square of a weighted real or imaginary part"
        if fit.data.standard_error is not None:
            size = f"{number(np.sqrt(fit.excess), 4)} times the standard errors of the data"
            yield "residuals", f"{size} (p = {number(fit.misfit_p_value, 2)})"
        sizes = f"N = {criteria.count} real equations and p = {criteria.parameters} parameters"
        yield "AICc, BIC", f"{number(criteria.aicc)}, {number(criteria.bic)} with {sizes}"
        yield "condition number", number(fit.condition_number, 3)
        yield from search_lines(fit, self.units)
        yield (
            "lines",
            "errors of neighbours pass as uncorrelated" if fit.white else "errors of neighbours are correlated",
        )

    def drawing(self) -> Drawing:
        """Return the figure of gain, phase and residuals."""
        return frequency_fit_drawing(self.fit, self.units)

    def content(self) -> dict[str, Any]:
        """Return the fit for ``fit.json`` and ``ctid fit --json``."""
        fit, data = self.fit, self.fit.data
        response = {
            "file": data.name,
            "lines": data.frequencies.size,
            "interval": data.interval or None,
            "weights": data.weight if data.standard_error is None else "standard_error",
            "residuals_over_standard_errors": None if data.standard_error is None else np.sqrt(fit.excess),
            "misfit_p_value": fit.misfit_p_value,
            "correlated": fit.correlated,
        }
        return {**fit_content(self.fitted, self.records, units=self.units), "frequency_response": as_plain(response)}


def line_frame(fit: FrequencyDomainFit, units: Units) -> pd.DataFrame:
    """Return values, model and residuals at each line."""
    data, model = fit.data, fit.answers(fit.data.frequencies)
    columns = {f"frequency [rad/{units.time}]": data.frequencies}
    for name, values in (("", data.response), ("model_", model), ("residual_", data.response - model)):
        columns |= {f"{name}real [{units.gain}]": values.real, f"{name}imaginary [{units.gain}]": values.imag}
    if data.standard_error is not None:
        columns[f"standard_error [{units.gain}]"] = data.standard_error
    return pd.DataFrame(columns)


def frequency_fit_drawing(fit: FrequencyDomainFit, units: Units) -> Drawing:
    """Gain and phase of values and model, and the residuals against the standard errors."""
    data = fit.data
    w = data.frequencies
    model = fit.answers(w)
    seen = w > 0.0

    def draw(figure: Figure) -> None:
        gain, phase, error = figure.subplots(3, 1, sharex=True, height_ratios=[1.5, 1.0, 1.0])
        angle = np.unwrap(np.angle(model))
        near = angle + np.angle(data.response * np.exp(-1j * angle))
        for axes, measured, fitted in (
            (gain, decibels(np.abs(data.response)), decibels(np.abs(model))),
            (phase, np.rad2deg(near), np.rad2deg(angle)),
        ):
            axes.semilogx(w[seen], measured[seen], ".", color=MIDDLE, markersize=3, label="values")
            axes.semilogx(w[seen], fitted[seen], color=DARK, linewidth=1.2, label="model")
        if data.standard_error is not None:
            level = decibels(data.standard_error)
            error.fill_between(
                w[seen], np.min(level) - 40.0, level[seen], color=BAND, linewidth=0.0, label="standard error"
            )
            error.set_ylim(bottom=float(np.min(level)) - 20.0)
        error.semilogx(
            w[seen], decibels(np.abs(data.response - model))[seen], ".", color=DARK, markersize=3, label="residual"
        )
        error.set_ylabel(f"residual [dB re 1 {plain(units.gain)}]")
        error.legend(loc="best", fontsize=8)
        name_axes(gain, phase, error, units)
        gain.set_title(plain(data.name), loc="left")

    return Drawing(8.0, 7.0, draw)
