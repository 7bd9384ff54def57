"""Experiment files to plans, with everything that is wrong in any of them reported before anything is done."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from ctid_cli.errors import Problem, SpecError, UsageError
from ctid_cli.reporting.layout import count

if TYPE_CHECKING:
    from ctid_cli.running.cells import Plan


def load_plans(configs: Sequence[Path], overrides: Sequence[str], runs: int | None = None) -> list[tuple[Path, Plan]]:
    """Read and check experiment files; warnings go to stderr."""
    from ctid_cli.running.plan import build_plan
    from ctid_cli.specification.load import load_spec

    problems: list[Problem] = []
    plans: list[tuple[Path, Plan]] = []
    for config in configs:
        try:
            plans.append((config, build_plan(load_spec(config, overrides), runs)))
        except SpecError as error:
            problems += error.problems
    if problems:
        raise SpecError(problems)
    seen: dict[str, Path] = {}
    for config, plan in plans:
        if plan.experiment in seen:
            both = f"{seen[plan.experiment]} and {config} both describe the experiment {plan.experiment!r}"
            raise UsageError(f"{both}; run them one at a time, or give one of them another name")
        seen[plan.experiment] = config
        for warning in plan.spec.warnings:
            typer.echo(f"warning: {warning}", err=True)
    return plans


def workload(plan: Plan) -> str:
    """How much work a plan asks for."""
    tasks = plan.tasks()
    estimates = sum(len(plan.keys(task)) for task in tasks)
    sets, cells = count(len(tasks), "data set"), count(len(plan.data_cells), "data cell")
    return f"{sets} ({cells}), {count(estimates, 'estimate')}"
