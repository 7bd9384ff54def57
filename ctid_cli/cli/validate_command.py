"""``ctid validate``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ctid_cli.cli._common import Overrides, guarded


@guarded
def validate(
    configs: Annotated[list[Path], typer.Argument(metavar="CONFIG", help="Experiment files (YAML).")],
    overrides: Overrides = None,
) -> None:
    """Check experiment files without running them.

    Prints every mistake with its place in the file, or how much work the experiment asks for.
    """
    from ctid_cli.cli._planning import load_plans, workload

    for config, plan in load_plans(configs, overrides or []):
        typer.echo(f"{config}: ok, {plan.experiment}: {workload(plan)}")
