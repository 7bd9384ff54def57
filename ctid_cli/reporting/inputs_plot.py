"""The figure of a fit with several inputs: output, residuals and their correlation, then a row for each input."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ctid_cli.estimators.identification import models_of
from ctid_cli.reporting.figures.style import Drawing, plain
from ctid_cli.reporting.fit_plot import FitFigures
from ctid_cli.reporting.model_plot import draw_bode, draw_step

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def inputs_drawing(figures: FitFigures) -> Drawing:
    """The figure of a fit with several inputs."""
    models, n = models_of(figures.result), figures.drawn

    def draw(figure: Figure) -> None:
        heights = [2.0, 1.2] * n + [2.0] + [1.4, 1.0] * len(models)
        grid = figure.add_gridspec(len(heights), 2, height_ratios=heights)
        figures.draw_experiments(figure, grid)
        figures.draw_autocorrelation(figure.add_subplot(grid[2 * n, 0]))
        figures.draw_cross_correlation(figure.add_subplot(grid[2 * n, 1]))
        for k, (name, model) in enumerate(models.items()):
            row, units = 2 * n + 1 + 2 * k, figures.units.of_input(k)
            step, gain = figure.add_subplot(grid[row : row + 2, 0]), figure.add_subplot(grid[row, 1])
            draw_step(step, model.step_response(), units)
            draw_bode(gain, figure.add_subplot(grid[row + 1, 1], sharex=gain), model.frequency_response(), units)
            for axes, what in ((step, "step of"), (gain, "response to")):
                axes.set_title(plain(f"{what} {name}"), loc="left")

    return Drawing(8.0, 3.4 * n + 2.8 + 3.2 * len(models), draw)
