"""Experiments from Python: running, reading, and tables of pandas."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ctid_cli.errors import MachineError
from ctid_cli.reporting import surprises as unexpected
from ctid_cli.reporting.document import Result, Section, Table
from ctid_cli.reporting.figures.experiment_plot import experiment_drawing
from ctid_cli.reporting.measures import Row, default_measures, measure_frame
from ctid_cli.reporting.paired_result import compare_estimators
from ctid_cli.reporting.results import Results
from ctid_cli.reporting.table_result import TableResult, experiment_table, notes_of
from ctid_cli.running import engine
from ctid_cli.running.plan import build_plan
from ctid_cli.running.trial import load_tried
from ctid_cli.storage.estimates import read_stored
from ctid_cli.storage.manifest import planned_count
from ctid_cli.text import count

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


class ExperimentResults(Results, Result):
    """Results of one experiment.

    Parameters
    ----------
    folder : pathlib.Path
        Folder in which they are stored.
    stored : Estimates
        The estimates that were read.

    See Also
    --------
    read_results, run_experiment
    """

    def __repr__(self) -> str:
        planned, stored = planned_count(self.manifest), len(self.stored)
        estimators = ", ".join(dict.fromkeys(part["name"] for part in self.manifest["estimators"]))
        head = f"{self.experiment}: {stored} of {planned} estimates by {estimators}, {self.failed} failed"
        return f"{head}\n  in {count(len(self.manifest['data_cells']), 'data cell')}, {self.folder}"

    @property
    def table(self) -> TableResult:
        """Table that ``ctid table`` prints."""
        return experiment_table(self, [*notes_of(self, self.out), *self.surprises])

    def sections(self) -> Sequence[Section]:
        """Return the table of the experiment."""
        return self.table.sections()

    def content(self) -> list[Row]:
        """Return the rows of the table."""
        return self.table.content()

    def main_table(self) -> Table:
        """Return one row for each estimate."""
        return Table.of_frame(self.estimates)

    def to_frame(self) -> pd.DataFrame:
        """Return one row for each estimate, equal to ``estimates``."""
        return self.estimates

    def plot(self) -> Figure:
        """Draw the main figure; ``figure`` has options."""
        return experiment_drawing(self).figure()

    @property
    def out(self) -> Path:
        """Results folder that contains this experiment's."""
        return self.folder.parents[len(Path(self.experiment).parts) - 1]

    @property
    def surprises(self) -> list[str]:
        """Deviations of the estimates from theory, with their reasons; empty if there are none."""
        return unexpected.surprises(self)

    def measures(self, *names: str) -> pd.DataFrame:
        """Return measures with their Monte Carlo errors, as ``ctid table --measure`` prints.

        Parameters
        ----------
        *names : str
            Such as ``"bias"``, ``"rmse:delay"``, ``"coverage"``; those of the specification by default, or the
            percentage of success, or bias and RMSE.

        Returns
        -------
        pandas.DataFrame
            One row for each cell, estimator, start, parameter and measure: ``value`` with its standard error ``error``
            and 95 % interval from ``low`` to ``high``, in ``unit``, from ``n`` data sets.

        Raises
        ------
        UsageError
            If there is no such measure, or this experiment cannot have it.
        """
        return measure_frame(self, names or default_measures(self) or ["percent"]).reset_index(drop=True)

    def compare(self, first: str, second: str) -> pd.DataFrame:
        """Return differences of two estimators on the same data sets, as ``ctid table --compare`` prints.

        Parameters
        ----------
        first, second : str
            Names of estimators in the specification.

        Returns
        -------
        pandas.DataFrame
            First minus second: ``value`` with its 95 % interval from ``low`` to ``high``, ``p_value`` and
            ``adjusted_p_value`` (Holm), of percentages, RMSE and CPU time.

        Raises
        ------
        UsageError
            If there is no such estimator, or they have too few data sets in common.
        """
        return compare_estimators(self, f"{first},{second}", self.out).to_frame().infer_objects()

    def figure(self, kind: str | None = None, measure: str | None = None, parameters: Sequence[str] = ()) -> Figure:
        """Return a figure of the experiment, as ``ctid figure`` draws.

        Parameters
        ----------
        kind : {"measure", "box"}, optional
            Kind of figure; by default the most informative one.
        measure : str, optional
            With ``measure``: the name of a measure, such as ``"rmse"`` or ``"rmse:delay"``.
        parameters : sequence of str, default ()
            With ``box``: names of parameters; all by default.

        Returns
        -------
        matplotlib.figure.Figure
            The figure, which a notebook shows.

        Raises
        ------
        UsageError
            If the experiment has no such figure.
        """
        return experiment_drawing(self, kind, measure, parameters).figure()


def read_results(folder: str | os.PathLike[str]) -> ExperimentResults:
    """Return the results of an experiment.

    Parameters
    ----------
    folder : path
        Its folder, such as ``results/quickstart``.

    Returns
    -------
    ExperimentResults
        The estimates and their measures.

    Raises
    ------
    UsageError
        If there are no results in the folder.

    Examples
    --------
    >>> from ctid_cli import read_results
    >>> results = read_results("results/quickstart")  # doctest: +SKIP
    >>> results.measures("bias", "coverage")  # doctest: +SKIP
    """
    return ExperimentResults(Path(folder), read_stored(Path(folder)))


def run_experiment(
    spec: str | os.PathLike[str] | Mapping[str, Any],
    out: str | os.PathLike[str] = "results",
    *,
    jobs: int | None = None,
    runs: int | None = None,
    overrides: Sequence[str] = (),
    fresh: bool = False,
    allow_mixed: bool = False,
    allow_code: bool = False,
) -> ExperimentResults:
    """Run an experiment, as ``ctid run`` does; a repeated call computes only missing estimates.

    Parameters
    ----------
    spec : path or mapping
        A specification: the path of a YAML file, or its content.
    out : path, default "results"
        Folder of results; this experiment has a subfolder of its name.
    jobs : int, optional
        Worker processes; all processors by default.
    runs : int, optional
        Data sets per setting, in place of the specification's number.
    overrides : sequence of str, default ()
        Values that replace those of the specification, such as ``"noise.snr_db=15"``.
    fresh : bool, default False
        Move older results aside and start again.
    allow_mixed : bool, default False
        Add to results of another version of the code or another processor.
    allow_code : bool, default False
        Run the code that the specification names as a kind.

    Returns
    -------
    ExperimentResults
        All stored estimates, also if a signal stopped the run.

    Raises
    ------
    SpecError
        If the specification has mistakes; all of them are listed.
    RefusedError
        If the folder holds another experiment or results of other code, or code may not be run.
    MachineError
        If the machine prevented estimates (memory, open files, killed processes); finished ones are stored.

    Examples
    --------
    >>> from ctid_cli import run_experiment
    >>> results = run_experiment("configs/quickstart.yaml", runs=5)  # doctest: +SKIP
    >>> results.estimates.groupby("estimator").delay.std()  # doctest: +SKIP
    """
    given = spec if isinstance(spec, Mapping) else Path(spec)
    plan = build_plan(load_tried(given, overrides, allow_code=allow_code), runs)
    for warning in plan.spec.warnings:
        warnings.warn(warning, stacklevel=2)
    folder = Path(out) / plan.experiment
    summary = engine.run_experiment(plan, folder, jobs=jobs, fresh=fresh, allow_mixed=allow_mixed)
    if summary.exit_code == MachineError.exit_code:
        raise summary.machine_error()
    return read_results(folder)
