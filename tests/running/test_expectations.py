"""Theoretical accuracy of the estimators of a plan: equal results of two methods."""

import numpy as np
import pytest

from ctid_cli.inference.bounds import cramer_rao_bound
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.running.plan import build_plan
from ctid_cli.running.theory import expectations
from ctid_cli.specification.load import load_spec
from tests.running.accuracy_cases import specification


@pytest.fixture
def accuracy(tmp_path):
    def call(case):
        return expectations(build_plan(load_spec(specification(case, tmp_path))))[0]

    return call


def errors(estimates, estimator):
    """Return the standard errors of an estimator at the greatest length."""
    entry = [entry for entry in estimates if entry["estimator"] == estimator][-1]
    return np.array([p["standard_error"] for p in entry["parameters"]])


def test_different_ways_to_the_same_numbers(accuracy, tmp_path):
    """Bound averaged over data sets; white noise of another kind; equal numbers of parameters in both forms."""
    found = errors(accuracy("an estimated delay"), "known")
    bounds = []
    plan = build_plan(load_spec(tmp_path / "spec.yaml"))
    for replicate in range(3):
        record = plan.data_cells[0].dataset(replicate).record
        level = np.sqrt(np.mean(record.noise_free**2) / 10)
        bounds.append(cramer_rao_bound(TransferFunction([2.0], [0.25, 0.7, 1.0], 0.35), record, level, 2.0))
    np.testing.assert_allclose(found, np.sqrt(np.diag(np.mean(bounds, axis=0))), rtol=1e-6)
    limit, levels = (errors(accuracy(case), "known") for case in ("many lengths", "an input of levels"))
    np.testing.assert_allclose(limit * np.sqrt(20000 / 6000), levels, rtol=0.05)
    both = accuracy("a fraction and its submodels")
    np.testing.assert_allclose(errors(both, "known"), errors(both, "sum"))
