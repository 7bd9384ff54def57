"""Result of ``ctid fit`` on a frequency response, and its figure."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ctid_cli.canonical import plain
from ctid_cli.estimators.frequency_domain import FrequencyDomainFit
from ctid_cli.estimators.identification import Identification
from ctid_cli.identification.sentences import spelled
from ctid_cli.inference.units import Units
from ctid_cli.reporting.document import Section, Table
from ctid_cli.reporting.estimate import PARAMETER
from ctid_cli.reporting.figures.style import BAND, DARK, MIDDLE, Drawing, name_axes
from ctid_cli.reporting.figures.style import plain as plain_text
from ctid_cli.reporting.fit_content import fit_content, parameters_of
from ctid_cli.reporting.fit_result import FitResult, form_of
from ctid_cli.reporting.frf_plot import decibels, name_response
from ctid_cli.reporting.layout import number
from ctid_cli.reporting.model_plot import bode_drawing, poles_chapter, step_drawing
from ctid_cli.reporting.pages.page import Chapter, shown
from ctid_cli.reporting.records import Records
from ctid_cli.text import count, probability

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Weights of lines without standard errors.
WEIGHTS = {
    "inverse": "reciprocal of the gain, for relative errors",
    "inverse-sqrt": "reciprocal of the square root of the gain",
    "none": "the same for all lines",
}
FIT_DEFINITION = "100 (1 - ||W (G - M)|| / ||W G||)"


@dataclass(frozen=True, eq=False)
class FrequencyFitResult(FitResult):
    """A fit to a frequency response."""

    @property
    def fine(self) -> str:
        """Sentence if there are no warnings."""
        return "The search ended well, and the residuals agree with what is known of the data."

    @classmethod
    def of(cls, fitted: Identification) -> FrequencyFitResult:
        """Return the result of a fit."""
        return cls(fitted, Records([]))

    @property
    def fit(self) -> FrequencyDomainFit:
        """Estimate."""
        assert isinstance(self.fitted.fit, FrequencyDomainFit)
        return self.fitted.fit

    @property
    def units(self) -> Units:
        """Units of the data."""
        time, output, input_ = self.fit.data.units
        return Units(time, input_, output)

    def data(self) -> Section:
        """Return the data, and notes from reading them."""
        data, time = self.fit.data, self.units.time
        low, high = data.frequencies[[0, -1]]
        name, lines = shown(data.name) or "frequency response", count(data.frequencies.size, "line")
        return Section(sentences=[f"{name}: {lines} from {low:.6g} to {high:.6g} rad/{time}", *data.notes])

    def settings(self) -> Iterator[tuple[str, str]]:
        """Yield the estimator, and the treatment of the data."""
        data, time = self.fit.data, self.units.time
        yield from self.structure()
        sampled = f"of samples at intervals of {data.interval:g} {time}, input constant between them"
        yield "response", sampled if data.interval else "in continuous time, G(jw)"
        if data.standard_error is None:
            yield "weights", f"{WEIGHTS[data.weight]} (--weight {data.weight})"
        else:
            yield "weights", "reciprocal of the standard errors"

    def parameters(self) -> Section:
        """Return the parameters with their uncertainty."""
        notes = [f"{self._errors()} {form_of(self.fit)}"]
        return Section(table=Table.of(parameters_of(self.fitted, self.units), PARAMETER), notes=notes)

    def _errors(self) -> str:
        """Return the assumptions of the standard errors."""
        fit, law = self.fit, self.fitted.uncertainty
        if not self.fitted.answer.seen:
            return "There are no standard errors, as the response is not distinguishable from noise."
        if not np.isfinite(np.diag(law.covariance)).any():
            return "There are no standard errors."
        if law.kind == "robust":
            why = "the lines share samples" if fit.data.correlated else "the residuals of neighbouring lines are"
            text = f"Standard errors are approximate, for correlated errors of neighbouring lines, as {why}"
        elif fit.errors_known:
            text = "Standard errors are based on those of the data, with which the residuals agree"
        else:
            text = "Standard errors are based on the residuals of the lines, assumed independent"
        return f"{text}; intervals are estimate -+ {law.spans()[0]} of them."

    def quality(self) -> Iterator[tuple[str, str]]:
        """Yield measures of the quality of the fit."""
        fit, criteria = self.fit, self.fitted.criteria
        yield "fit", f"{number(fit.fit_percent, 5)} % = {FIT_DEFINITION}"
        yield "", "G values, M model, W weights"
        yield "cost", f"{number(fit.cost)}, mean square of a weighted real or imaginary part"
        if fit.data.standard_error is not None:
            size = f"{number(np.sqrt(fit.excess), 4)} times the standard errors of the data"
            yield "residuals", f"{size} ({probability(fit.misfit_p_value)})"
        sizes = f"N = {criteria.count} real equations, p = {criteria.parameters} parameters"
        yield "AICc, BIC", f"{number(criteria.aicc)}, {number(criteria.bic)}; {sizes}"
        yield from self.search()

    def drawing(self) -> Drawing:
        """Return the figure of gain, phase and residuals."""
        return frequency_fit_drawing(self.fit, self.units)

    def page_head(self) -> tuple[str, str]:
        """Return the title of the page, and the quality of the fit."""
        fit = self.fit
        lines = count(fit.data.frequencies.size, "weighted line")
        structure = f"{spelled(self.fitted.options)}{self.lost_poles}"
        lead = f"{structure}. Fit {number(fit.fit_percent, 4)} % on {lines}. {fit.status.value}"
        return f"Fit of {shown(fit.data.name) or 'a frequency response'}", lead

    def chapters(self) -> Iterator[Chapter]:
        """Return data, model and figures."""
        found, units = self.fitted, self.units
        bode = bode_drawing(found.frequency_response(), None, units)
        bands = "of the model, with pointwise 95 % bands."
        yield from self.chapters_of_numbers()
        yield Chapter("Values and model", [Section(drawing=self.drawing(), caption="Values, model and residuals.")])
        step = Section(drawing=step_drawing(found.step_response(), units), caption=f"Response to a unit step {bands}")
        yield Chapter("Responses", [Section(drawing=bode, caption=f"Frequency response {bands}"), step])
        yield poles_chapter(found, units)

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
        return {**fit_content(self.fitted, self.records, units=self.units), "frequency_response": plain(response)}


def frequency_fit_drawing(fit: FrequencyDomainFit, units: Units) -> Drawing:
    """Return a figure of gain and phase of values and model, and the residuals with the standard errors."""
    data, seen = fit.data, fit.data.frequencies > 0.0
    w, values, model = data.frequencies[seen], data.response[seen], fit.responses_at(data.frequencies)[seen]
    angle = np.unwrap(np.angle(model))
    near = angle + np.angle(values * np.exp(-1j * angle))
    panels = ((decibels(np.abs(values)), decibels(np.abs(model))), (np.rad2deg(near), np.rad2deg(angle)))

    def draw(figure: Figure) -> None:
        gain, phase, error = figure.subplots(3, 1, sharex=True, height_ratios=[1.5, 1.0, 1.0])
        for axes, (measured, fitted) in zip((gain, phase), panels, strict=True):
            axes.semilogx(w, measured, ".", color=MIDDLE, markersize=3, label="values")
            axes.semilogx(w, fitted, color=DARK, linewidth=1.2, label="model")
        if data.standard_error is not None:
            level = decibels(data.standard_error[seen])
            lowest = float(np.min(level)) - 20.0
            error.fill_between(w, lowest, level, color=BAND, linewidth=0.0, label="standard error")
            error.set_ylim(bottom=lowest)
        error.semilogx(w, decibels(np.abs(values - model)), ".", color=DARK, markersize=3, label="residual")
        name_response(gain, phase, error, units)
        name_axes(error, y=f"residual [{units.amount('dB re 1', units.gain)}]", legend="best")
        gain.set_title(plain_text(shown(data.name)), loc="left")

    return Drawing(8.0, 7.0, draw)
