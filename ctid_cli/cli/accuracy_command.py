"""``ctid accuracy``."""

from pathlib import Path

from ctid_cli.cli._common import AllowCode, AllowOutside, Config, Out, Overrides, emit, guarded
from ctid_cli.cli._options import FormatOptions
from ctid_cli.cli.experiment_commands import load_plans


@guarded
def accuracy(
    config: Config,
    form: FormatOptions,
    overrides: Overrides = None,
    out: Out = Path("results"),
    allow_code: AllowCode = False,
    allow_outside: AllowOutside = False,
) -> None:
    """Compute the standard errors to expect of an experiment.

    No data are needed. For every estimator and the swept numbers of samples: the standard error of each parameter by theory, with the
    formula that it comes from. White Gaussian excitation on a regular clock has a limit for long records; otherwise
    the sensitivities of the experiment's first data sets count. Where the experiment has results in OUT, what is
    unexpected about them comes last.
    """
    from ctid_cli.reporting.accuracy_result import accuracy_of
    from ctid_cli.reporting.results import find_results

    ((_, plan),) = load_plans([config], overrides or [], allow_code=allow_code, allow_outside=allow_outside)
    emit(accuracy_of(plan, find_results(out, plan.experiment)), form.form)
