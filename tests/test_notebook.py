"""The notebook of the documentation runs, and is stored without output."""

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOK = Path(__file__).resolve().parents[1] / "docs" / "examples" / "first-study.ipynb"


@pytest.mark.slow
def test_the_notebook_runs_and_shows_what_it_speaks_of(tmp_path):
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert not any(cell.outputs or cell.execution_count for cell in cells)
    NotebookClient(notebook, timeout=600, kernel_name="python3", resources={"metadata": {"path": tmp_path}}).execute()
    shown = [output for cell in cells for output in cell.outputs]
    assert [output.text for output in shown if output.output_type == "stream"] == ["fit_percent [%]\n"]
    answers = [output.data for output in shown if output.output_type == "execute_result"]
    # Every cell with a result at its end shows it: figures as pictures, everything else as tables.
    assert sum("image/svg+xml" in answer for answer in answers) == 2
    assert sum("<td" in answer.get("text/html", "") for answer in answers) == 6
    assert answers[-1]["text/plain"] == "[]"
