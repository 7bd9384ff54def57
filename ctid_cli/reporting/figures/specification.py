"""The plans of published experiments, from the specifications that a checkout carries."""

from __future__ import annotations

from ctid_cli.errors import UsageError
from ctid_cli.reporting.study import data_folder
from ctid_cli.running.plan import Plan, build_plan
from ctid_cli.specification.load import load_spec


def published_plan(config: str) -> Plan:
    """Plan of a published experiment."""
    file = data_folder("configs") / config
    if not file.is_file():
        raise UsageError(
            f"this figure is computed from the specification {file.parent.name}/{file.name}, which an installed "
            "package does not carry; run ctid figure in a checkout of the repository"
        )
    return build_plan(load_spec(file))
