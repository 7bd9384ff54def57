"""Where the estimates of a plan come from if they are computed now."""

from ctid_cli.running.cells import Plan
from ctid_cli.storage.identity import Origin, code_version, modules_of, origin_of


def current_origins(plan: Plan) -> dict[str, Origin]:
    """Where the estimates of each estimator will come from, by hash."""
    # All data cells are made by the same classes; only the values of their fields differ.
    source = plan.data_cells[0].source
    return {cell.hash: origin_of(source, cell.estimator) for cell in plan.estimators}


def current_versions(plan: Plan) -> set[str]:
    """The code versions of these origins, on whichever processor."""
    source = modules_of(plan.data_cells[0].source)
    return {code_version(source, modules_of(cell.estimator)) for cell in plan.estimators}
