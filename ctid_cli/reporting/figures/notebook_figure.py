"""A figure that a notebook shows without pyplot."""

import io

from matplotlib.figure import Figure


class NotebookFigure(Figure):
    """A Matplotlib figure with an SVG for notebooks."""

    def _repr_svg_(self) -> str:
        file = io.BytesIO()
        self.savefig(file, format="svg", metadata={"Date": None})
        return file.getvalue().decode()
