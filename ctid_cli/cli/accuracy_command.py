"""``ctid accuracy``."""

from pathlib import Path

from ctid_cli.cli._common import Config, Out, emit, guarded
from ctid_cli.cli._options import FormatOptions
from ctid_cli.cli.experiment_commands import SpecOptions


@guarded
def accuracy(
    config: Config,
    spec: SpecOptions,
    form: FormatOptions,
    out: Out = Path("results"),
) -> None:
    """Compute the standard errors to expect of an experiment.

    No data are needed.

    For every estimator and the swept numbers of samples: the standard error of each parameter by theory, with the
    formula that it comes from. White Gaussian excitation on a regular clock has a limit for long records; otherwise
    the sensitivities of the experiment's first data sets count. Where the experiment has results in OUT, what is
    unexpected about them comes last.
    """
    from ctid_cli.reporting.accuracy_result import AccuracyResult
    from ctid_cli.reporting.results import find_results

    ((_, plan),) = spec.plans([config])
    emit(AccuracyResult.of(plan, find_results(out, plan.experiment)), form.form)
