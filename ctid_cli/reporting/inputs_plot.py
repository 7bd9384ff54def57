"""The figure of a fit with several inputs: output, residuals and their correlation, then a row for each input."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from ctid_cli.estimators.identification import Identification, models_of
from ctid_cli.inference.fitted_model import FittedModel
from ctid_cli.reporting.estimate import Units
from ctid_cli.reporting.figures.style import Drawing, plain
from ctid_cli.reporting.fit_plot import MOST_DRAWN, draw_correlations, draw_records
from ctid_cli.reporting.frf_plot import name_axes
from ctid_cli.reporting.model_plot import draw_bode, draw_response
from ctid_cli.signals.measurement import Measurement

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def inputs_drawing(result: Identification, measurements: Sequence[Measurement], units: Units) -> Drawing:
    """The figure of a fit with several inputs."""
    models, drawn = models_of(result), measurements[:MOST_DRAWN]

    def draw(figure: Figure) -> None:
        heights = [2.0, 1.2] * len(drawn) + [2.0] + [1.4, 1.0] * len(models)
        grid = figure.add_gridspec(len(heights), 2, height_ratios=heights)
        draw_records(figure, grid, result, measurements, units)
        first = 2 * len(drawn)
        both = figure.add_subplot(grid[first, 0]), figure.add_subplot(grid[first, 1])
        draw_correlations(both, result, len(measurements))
        for k, (name, model) in enumerate(models.items()):
            row = first + 1 + 2 * k
            step, gain = figure.add_subplot(grid[row : row + 2, 0]), figure.add_subplot(grid[row, 1])
            phase = figure.add_subplot(grid[row + 1, 1], sharex=gain)
            draw_input(step, gain, phase, name, model, units.of_input(k))

    return Drawing(8.0, 3.4 * len(drawn) + 2.8 + 3.2 * len(models), draw)


def draw_input(step: Any, gain: Any, phase: Any, name: str, model: FittedModel, units: Units) -> None:
    """Step response, gain and phase of the transfer function of one input."""
    draw_response(step, model.step_response(), f"step of {name}")
    step.set_xlabel(f"time after the step [{plain(units.time)}]")
    step.set_ylabel(f"output [{plain(units.gain)}]")
    step.margins(x=0.0)
    step.legend(loc="best", fontsize=8)
    draw_bode(gain, phase, model.frequency_response(), f"response to {name}")
    name_axes(gain, phase, phase, units)
