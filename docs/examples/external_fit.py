"""An estimator that hands the record to another program: here a Python script, as well Rscript, julia, octave."""

import io
import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ctid_cli import Estimator

TOOL = [sys.executable, str(Path(__file__).with_name("external_tool.py"))]


@dataclass(frozen=True)
class ExternalFit(Estimator):
    """The fit of another program.

    Parameters
    ----------
    patience : float, default 60.0
        The program is ended after this [s].
    """

    patience: float = 60.0

    def fit(self, record, start):
        table, columns = io.StringIO(), (record.t, record.input.at(record.t), record.y)
        np.savetxt(table, np.column_stack(columns), delimiter=",", header="t,u,y", comments="")
        done = subprocess.run(TOOL, input=table.getvalue(), capture_output=True, text=True, timeout=self.patience)
        if done.returncode:
            raise RuntimeError(done.stderr.strip())
        return {"parameters": json.loads(done.stdout), "status": "LEAST_SQUARES"}
