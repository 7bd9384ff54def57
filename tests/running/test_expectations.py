"""Theoretical accuracy of the estimators of a plan: published numbers, and equal results of two methods."""

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


def errors(estimates, estimator, k=-1):
    """Return standard errors of an estimator at one of the lengths, with the number of samples."""
    entry = [entry for entry in estimates if entry["estimator"] == estimator][k]
    return np.array([p["standard_error"] for p in entry["parameters"]]), entry["samples"]


def variances(estimates, estimator, letter, k=-1):
    """Return N times the variances of the parameters with a name ending."""
    found, samples = errors(estimates, estimator, k)
    names = next(entry for entry in estimates if entry["estimator"] == estimator)["parameters"]
    return [samples * e**2 for e, p in zip(found, names, strict=True) if p["name"].endswith(letter)]


def test_the_printed_variances_of_the_paper(accuracy):
    found = accuracy("open loop, coloured noise")
    for k in (1, 2):
        np.testing.assert_allclose(variances(found, "sum", "b0", k), [35.60, 2.700, 0.4405, 0.2240], rtol=3e-4)
    np.testing.assert_allclose(variances(found, "srivc", "b0"), [36.75, 3.645, 0.5341, 0.2322], rtol=3e-4)
    # Short records use data sets, which is another method.
    ratios = np.array(variances(found, "sum", "b0", 0)) / variances(found, "sum", "b0")
    assert 1e-3 < np.abs(ratios - 1).max() < 0.4
    found = accuracy("closed loop")
    np.testing.assert_allclose(variances(found, "sum", "a2"), [0.035010, 1.52180e-5], rtol=1e-4)
    np.testing.assert_allclose(variances(found, "clsrivc", "a2"), [0.090118, 2.49911e-5], rtol=1e-4)
    direct, closed = variances(found, "direct", "b0"), variances(found, "clsrivc", "b0")
    np.testing.assert_allclose(1.01 * np.array(direct), closed, rtol=1e-6)


def test_different_ways_to_the_same_numbers(accuracy, tmp_path):
    """Bound averaged over data sets; white noise of another kind; equal numbers of parameters in both forms."""
    found, _ = errors(accuracy("an estimated delay"), "known")
    bounds = []
    plan = build_plan(load_spec(tmp_path / "spec.yaml"))
    for replicate in range(3):
        record = plan.data_cells[0].dataset(replicate).record
        level = np.sqrt(np.mean(record.noise_free**2) / 10)
        bounds.append(cramer_rao_bound(TransferFunction([2.0], [0.25, 0.7, 1.0], 0.35), record, level, 2.0))
    np.testing.assert_allclose(found, np.sqrt(np.diag(np.mean(bounds, axis=0))), rtol=1e-6)
    limit, levels = (errors(accuracy(case), "known")[0] for case in ("many lengths", "an input of levels"))
    np.testing.assert_allclose(limit * np.sqrt(20000 / 6000), levels, rtol=0.05)
    both = accuracy("a fraction and its submodels")
    np.testing.assert_allclose(errors(both, "known")[0], errors(both, "sum")[0])
