"""The page of a fit to a frequency response."""

from collections.abc import Mapping
from typing import Any

from ctid_cli.reporting.citations import bibtex
from ctid_cli.reporting.document import Section, pairs
from ctid_cli.reporting.frequency_fit import FrequencyFitResult
from ctid_cli.reporting.layout import number
from ctid_cli.reporting.model_plot import bode_drawing, poles_drawing, step_drawing
from ctid_cli.reporting.pages.fit_page import DIGITS
from ctid_cli.reporting.pages.page import Chapter, citation, provenance, write_page
from ctid_cli.reporting.pages.question import formula
from ctid_cli.text import count

#: What stands in the place of warnings.
FINE = "The search ended well, and the residuals agree with what is known of the data."


def frequency_fit_page(result: FrequencyFitResult, content: Mapping[str, Any]) -> str:
    """Return the page as HTML, of a fit and what its file says."""
    fitted, fit, units = result.fitted, result.fit, result.units
    model = fit.model
    terms = [(model.numerator.tolist(), model.denominator.tolist(), 0)]
    equation = formula(terms, delayed=model.delay > 0, digits=DIGITS)
    bode = bode_drawing(fitted.frequency_response(), None, units)
    origin = [("ctid", str(content["ctid"])), ("frequency response", "its values are in the file of the fit")]
    chapters = [
        Chapter("Before using it", [Section(sentences=[f"- {text}" for text in fitted.warnings] or [FINE])]),
        Chapter("Data", [result.data(), Section(frame=pairs(result.settings()))]),
        Chapter("Values and model", [Section(drawing=result.drawing(), caption="Values, model and residuals.")]),
        Chapter("Model", [Section(sentences=[equation]), result.parameters(), result.derived()]),
        Chapter("How good it is", [Section(frame=pairs(result.quality()))]),
        Chapter(
            "Responses",
            [
                Section(drawing=bode, caption="Frequency response of the model, with pointwise 95 % bands."),
                Section(
                    drawing=step_drawing(fitted.step_response(), units),
                    caption="Response to a unit step, with its pointwise band.",
                ),
            ],
        ),
        Chapter(
            "Poles",
            [
                Section(
                    drawing=poles_drawing(fitted.poles(), model.zeros, units),
                    caption="Poles with their regions, and zeros.",
                )
            ],
        ),
        Chapter("Provenance", provenance(origin, content["command"])),
        Chapter("How to cite", citation(bibtex(fitted))),
    ]
    lead = f"{count(model.order, 'pole')}, {count(fitted.options.zeros, 'zero')}: {number(fit.fit_percent, 4)} % of "
    lead += f"{count(fit.data.frequencies.size, 'weighted line')}. {fit.status.value}"
    return write_page(f"Fit of {fit.data.name or 'a frequency response'}", lead, chapters)
