"""Capture of drawn figures."""

import pytest

from ctid_cli.reporting.figures.style import Drawing


@pytest.fixture
def drawn(monkeypatch):
    """Return Matplotlib figures in drawing order, in place of SVG files."""
    from matplotlib.figure import Figure

    figures = []

    def keep(drawing):
        figures.append(Figure(figsize=drawing[:2], layout="constrained"))
        drawing.draw(figures[-1])
        return b""

    monkeypatch.setattr(Drawing, "saved", keep)
    return figures
