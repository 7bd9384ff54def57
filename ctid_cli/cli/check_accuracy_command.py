"""``ctid check accuracy``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ctid_cli.cli._common import Json, Overrides, echo_json, guarded


@guarded
def check_accuracy(
    config: Annotated[Path, typer.Argument(metavar="CONFIG", help="Experiment file (YAML).")],
    overrides: Overrides = None,
    as_json: Json = False,
) -> None:
    """Say how accurate the estimates of an experiment can be, before any data are taken.

    For every estimator and the swept numbers of samples: the standard error of each parameter by theory, with the
    formula that it comes from. White Gaussian excitation on a regular clock has a limit for long records; otherwise
    the sensitivities of the experiment's first data set count.
    """
    from ctid_cli.cli._planning import load_plans
    from ctid_cli.reporting.accuracy_report import accuracy_object, accuracy_text

    ((_, plan),) = load_plans([config], overrides or [])
    content = accuracy_object(plan)
    if as_json:
        echo_json(content)
    else:
        typer.echo(accuracy_text(content))
