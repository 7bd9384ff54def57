"""The page of one fit: what was measured, the model, what it does, and whether to believe it."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

import ctid_cli
from ctid_cli.arrays import Array
from ctid_cli.errors import DataError
from ctid_cli.estimators.identification import Identification, costs_about_delay
from ctid_cli.inference.frequency_response import FrequencyResponse, estimate_frequency_response
from ctid_cli.reporting.citations import bibtex
from ctid_cli.reporting.estimate import Units, parameter_table
from ctid_cli.reporting.fit_drawings import (
    bode_drawing,
    delay_drawing,
    poles_drawing,
    step_drawing,
    validation_drawing,
)
from ctid_cli.reporting.identification_plot import MOST_DRAWN, identification_drawing
from ctid_cli.reporting.identification_report import (
    asked_for,
    covariance_line,
    derived_block,
    derived_of,
    parameters_of,
    quality,
    record_line,
)
from ctid_cli.reporting.layout import Report, Table, count, number
from ctid_cli.reporting.pages.page import Chapter, figure, shown, shown_command, written
from ctid_cli.reporting.pages.question import Fraction, polynomial
from ctid_cli.signals.measurement import Measurement

#: Digits of the coefficients in the equation.
DIGITS = 5
#: Frequencies at which a model is drawn.
POINTS = 500


def fit_page(
    result: Identification,
    measurements: Sequence[Measurement],
    validation: Measurement | None,
    content: Mapping[str, Any],
) -> str:
    """The page as HTML, of a fit and what its file says."""
    units = Units(**content["units"])
    chapters = list(_chapters(result, measurements, validation, units))
    return written(
        "fit.html",
        title="Fit of " + ", ".join(measurement.record.name or "a record" for measurement in measurements),
        version=ctid_cli.__version__,
        lead=_lead(result),
        warnings=result.warnings,
        data=_data(result, measurements, units),
        equation=_equation(result),
        model=_model(result, units),
        chapters=chapters,
        titles=[("model", "Model"), *((chapter.name, chapter.title) for chapter in chapters)],
        provenance=_provenance(content),
        command=shown_command(content["command"]),
        bibtex=bibtex(result),
    )


def _lead(result: Identification) -> str:
    fit, judged = result.fit, result.validation
    model = f"{count(fit.model.order, 'pole')}, {count(result.options.zeros, 'zero')}"
    beyond = f"; {number(judged.fit_percent, 4)} % on {judged.name}, which it was not made from" if judged else ""
    return (
        f"{model}: simulates {number(fit.fit_percent, 4)} % of {count(fit.count, 'sample')}{beyond}. {fit.status.value}"
    )


def _equation(result: Identification) -> tuple[list[Fraction], bool]:
    model = result.fit.model
    above, below = polynomial(model.numerator.tolist(), DIGITS), polynomial(model.denominator.tolist(), DIGITS)
    return [Fraction(above, below, 0)], model.delay > 0


def _data(result: Identification, measurements: Sequence[Measurement], units: Units) -> Report:
    lines: list[str | Table] = []
    for measurement, use in zip(measurements, result.fit.used, strict=True):
        lines += [record_line(measurement, int(np.count_nonzero(use)), units), *measurement.notes]
    rows = [[label, text] for label, text in asked_for(result, measurements, units)]
    return Report([lines, [Table(["", ""], rows, "ll")]])


def _model(result: Identification, units: Units) -> Report:
    rows: list[list[str]] = []
    for label, text in quality(result, units):
        if not label:
            rows[-1][1] += f"; {text}"
        elif not label.startswith("residuals"):  # these have a chapter of their own
            rows.append([label, text])
    return Report(
        [
            [parameter_table(parameters_of(result, units)), covariance_line(result)],
            ["### What follows from them", *derived_block(derived_of(result, units))],
            ["### How good it is", Table(["", ""], rows, "ll")],
        ]
    )


def _provenance(content: Mapping[str, Any]) -> Report:
    rows = [["ctid", str(content["ctid"])]]
    named = [("record", each) for each in content["records"]]
    named += [("validation record", content["validation"])] if content["validation"] else []
    for label, each in named:
        if each["path"] is None:
            rows.append([label, "its samples are in the file of the fit"])
        else:
            window = [f"{word} {each[word]}" for word in ("from", "to") if each[word] is not None]
            rows.append([label, ", ".join([shown(str(each["path"])), f"hold {each['hold']}", *window])])
            rows.append(["its SHA-256", str(each["sha256"])])
    rows.append(["checksum of the fit", str(content.get("checksum", ""))])
    return Report([[Table(["", ""], rows, "ll")]])


# --- figures ---------------------------------------------------------------------------------------


def _chapters(
    result: Identification, measurements: Sequence[Measurement], validation: Measurement | None, units: Units
) -> Iterator[Chapter]:
    more = len(measurements) - MOST_DRAWN
    notes = [f"{more} more experiments are not drawn."] if more > 0 else []
    overlay = [
        figure(identification_drawing(result, measurements, units, "overlay"), "overlay", "Measured and simulated")
    ]
    judged = result.validation
    if judged is not None and validation is not None:
        caption = f"The same on {judged.name}, from which nothing was estimated but the initial state and the offset"
        overlay.append(figure(validation_drawing(judged, validation, units), "validation", caption))
    yield Chapter("output", "Output", overlay, notes)
    figures = [figure(identification_drawing(result, measurements, units, "residuals"), "residuals", "What is left")]
    if result.tests:
        drawing = identification_drawing(result, measurements, units, "correlation")
        figures.append(figure(drawing, "correlation", "Their correlation with themselves and with the input"))
    yield Chapter("residuals", "Residuals", figures, [test.sentence for test in result.tests])
    yield _responses(result, measurements, units)
    yield Chapter(
        "poles",
        "Poles",
        [
            figure(
                poles_drawing(result.poles(), result.fit.model.zeros, units),
                "poles",
                "Poles with their regions, and zeros",
            )
        ],
    )
    if result.fit.profile is not None:
        near = costs_about_delay(result)
        caption = "The search over the whole range" + (", and the cost about the estimate" if near else "")
        yield Chapter("delay", "Delay", [figure(delay_drawing(result, near, units), "delay", caption)])


def _responses(result: Identification, measurements: Sequence[Measurement], units: Units) -> Chapter:
    """The model over frequency and time, with the frequency response that the first record shows without a model."""
    notes: list[str] = []
    found = None
    try:
        found = estimate_frequency_response(measurements[0].record, time_unit=units.time)
        notes += found.notes
    except DataError as error:
        notes.append(f"The record gives no frequency response without a model: {error}.")
    band = result.frequency_response(None if found is None else _frequencies(result, found))
    figures = [
        figure(bode_drawing(band, found, units), "bode", "Frequency response, with pointwise 95 % bands"),
        figure(step_drawing(result.step_response(), units), "step", "Response to a unit step, with its pointwise band"),
    ]
    return Chapter("responses", "Responses", figures, notes)


def _frequencies(result: Identification, found: FrequencyResponse) -> Array:
    """Frequencies at which the model is drawn: its own, and those of the record."""
    own = result.frequency_response().frequencies
    low, high = min(own[0], found.frequencies[0]), max(own[-1], found.frequencies[-1])
    return np.geomspace(low, high, POINTS)
