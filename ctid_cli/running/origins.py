"""Where the estimates of a plan come from if they are computed now."""

from ctid_cli.running.cells import Plan
from ctid_cli.storage.identity import Origin, code_version, modules_of, origin_of


def current_origin(plan: Plan) -> Origin:
    """Where the estimates of a plan will come from."""
    # All data cells are made by the same classes; only the values of their fields differ.
    return origin_of(plan.data_cells[0].source, *(cell.estimator for cell in plan.estimators))


def current_version(plan: Plan) -> str:
    """The code version of these estimates, on whichever processor."""
    parts = (plan.data_cells[0].source, *(cell.estimator for cell in plan.estimators))
    return code_version(set().union(*map(modules_of, parts)))
