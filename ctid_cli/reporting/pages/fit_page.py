"""The page of one fit: what was measured, the model, what it does, and whether to believe it."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError
from ctid_cli.estimators.identification import Identification, costs_about_delay, models_of
from ctid_cli.inference.frequency_response import FrequencyResponse, estimate_frequency_response
from ctid_cli.models.several_inputs import fractions_of
from ctid_cli.reporting.citations import bibtex
from ctid_cli.reporting.document import Section, pairs
from ctid_cli.reporting.estimate import Units
from ctid_cli.reporting.fit_plot import MOST_DRAWN, Kind, identification_drawing
from ctid_cli.reporting.fit_result import FitResult
from ctid_cli.reporting.layout import number
from ctid_cli.reporting.model_plot import (
    bode_drawing,
    delay_drawing,
    poles_drawing,
    step_drawing,
    validation_drawing,
)
from ctid_cli.reporting.pages.page import Chapter, citation, provenance, shown, write_page
from ctid_cli.reporting.pages.question import formula
from ctid_cli.signals.measurement import Measurement
from ctid_cli.text import count

#: What stands in the place of warnings.
FINE = "The search ended well, the residuals pass their tests, and no change that was tried gives a better fit."
#: Digits of the coefficients in the equation.
DIGITS = 5
#: Frequencies at which a model is drawn.
POINTS = 500


def fit_page(result: FitResult, content: Mapping[str, Any]) -> str:
    """Return the page as HTML, of a fit and what its file says."""
    fitted = result.fitted
    names = models_of(fitted)
    equations = []
    for name, model in zip(names, fractions_of(fitted.fit.model), strict=True):
        terms = [(model.numerator.tolist(), model.denominator.tolist(), 0)]
        equation = formula(terms, delayed=model.delay > 0, digits=DIGITS)
        equations.append(f"Response to {name}: {equation}" if name else equation)
    quality = Section("How good it is", frame=pairs(result.quality()))
    chapters = [
        Chapter("Before using it", [Section(sentences=[f"- {text}" for text in fitted.warnings] or [FINE])]),
        Chapter("Data", [result.data(), Section(frame=pairs(result.settings()))]),
        Chapter("Model", [Section(sentences=equations), result.parameters(), result.derived(), quality]),
        *_figures(fitted, result.records.measurements, result.records.validation, result.units),
        Chapter("Provenance", provenance(_origin(content), content["command"])),
        Chapter("How to cite", citation(bibtex(fitted))),
    ]
    title = "Fit of " + ", ".join(record.name or "a record" for record in result.records.data)
    return write_page(title, _lead(fitted), chapters)


def _lead(result: Identification) -> str:
    fit, validation = result.fit, result.validation
    lead = f"{count(fit.model.order, 'pole')}, {count(result.options.zeros, 'zero')}: simulates "
    lead += f"{number(fit.fit_percent, 4)} % of {count(fit.count, 'sample')}"
    if validation is not None:
        lead += f"; {number(validation.fit_percent, 4)} % on {validation.name}, which it was not made from"
    return f"{lead}. {fit.status.value}"


def _origin(content: Mapping[str, Any]) -> list[tuple[str, str]]:
    rows = [("ctid", str(content["ctid"]))]
    named = [("record", each) for each in content["records"]]
    named += [("validation record", content["validation"])] if content["validation"] else []
    for label, each in named:
        if each["path"] is None:
            rows.append((label, "its samples are in the file of the fit"))
        else:
            window = [f"{word} {each[word]}" for word in ("from", "to") if each[word] is not None]
            rows.append((label, ", ".join([shown(str(each["path"])), f"hold {each['hold']}", *window])))
            rows.append(("its SHA-256", str(each["sha256"])))
    return [*rows, ("checksum of the fit", str(content.get("checksum", "")))]


# --- figures ---------------------------------------------------------------------------------------


def _figures(
    result: Identification, measurements: Sequence[Measurement], validation: Measurement | None, units: Units
) -> Iterator[Chapter]:
    def part(kind: Kind, caption: str, notes: Sequence[str] = ()) -> Section:
        return Section(drawing=identification_drawing(result, measurements, units, kind), caption=caption, notes=notes)

    more = len(measurements) - MOST_DRAWN
    output = [part("overlay", "Measured and simulated.")]
    outcome = result.validation
    if outcome is not None and validation is not None:
        caption = f"The same on {outcome.name}, from which nothing was estimated but the initial state and the offset."
        output.append(Section(drawing=validation_drawing(outcome, validation, units), caption=caption))
    output += [Section(sentences=[f"{more} more experiments are not drawn."])] if more > 0 else []
    yield Chapter("Output", output)
    residuals = [part("residuals", "Residuals.")]
    residuals += [part("correlation", "Their correlation with themselves and with the input.")] if result.tests else []
    yield Chapter("Residuals", [*residuals, Section(notes=[test.sentence for test in result.tests])])
    yield Chapter("Responses", _responses(result, measurements, units))
    drawn = []
    for (name, model), fraction in zip(models_of(result).items(), fractions_of(result.fit.model), strict=True):
        of = f" of the response to {name}" if name else ""
        poles = poles_drawing(model.poles(), fraction.zeros, units)
        drawn.append(Section(drawing=poles, caption=f"Poles with their regions, and zeros{of}."))
    yield Chapter("Poles", drawn)
    if result.fit.profile is not None:
        near = costs_about_delay(result)
        caption = "The search over the whole range" + (", and the cost about the estimate." if near else ".")
        yield Chapter("Delay", [Section(drawing=delay_drawing(result, near, units), caption=caption)])


def _responses(result: Identification, measurements: Sequence[Measurement], units: Units) -> list[Section]:
    """Return the model over frequency and time, with the frequency response of the first record without a model."""
    if measurements[0].record.several:
        sections = []
        for k, (name, model) in enumerate(models_of(result).items()):
            own = units.of_input(k)
            bode = bode_drawing(model.frequency_response(), None, own)
            sections.append(Section(drawing=bode, caption=f"Frequency response to {name}, with pointwise 95 % bands."))
            step = step_drawing(model.step_response(), own)
            sections.append(Section(drawing=step, caption=f"Response to a unit step of {name}, with its band."))
        return sections
    notes: list[str] = []
    found = None
    try:
        found = estimate_frequency_response(measurements[0].record, time_unit=units.time)
        notes += found.notes
    except DataError as error:
        notes.append(f"The record gives no frequency response without a model: {error}.")
    band = result.frequency_response(None if found is None else _frequencies(result, found))
    step = step_drawing(result.step_response(), units)
    return [
        Section(drawing=bode_drawing(band, found, units), caption="Frequency response, with pointwise 95 % bands."),
        Section(drawing=step, caption="Response to a unit step, with its pointwise band."),
        Section(notes=notes),
    ]


def _frequencies(result: Identification, found: FrequencyResponse) -> Array:
    """Return the frequencies at which the model is drawn: its own, and those of the record."""
    own = result.frequency_response().frequencies
    low, high = min(own[0], found.frequencies[0]), max(own[-1], found.frequencies[-1])
    return np.geomspace(low, high, POINTS)
