"""Results of experiments drawn from the theoretical distribution of the estimates, without records."""

import numpy as np

from ctid_cli.reporting.results import Results
from ctid_cli.running.plan import build_plan
from ctid_cli.running.theory import long_record_variances
from ctid_cli.specification.load import load_spec
from ctid_cli.storage.manifest import Key, true_values
from tests.storage.made_results import MadeResults

#: Two modes, two numbers of samples, and an estimator of each form.
TWO_MODES = """\
experiment: two-modes
system:
  additive:
    - {numerator: [1], denominator: [0.025, 0.01, 1]}      # the faster one first: estimates are sorted
    - {numerator: [3], denominator: [0.25, 0.25, 1]}
excitation:  {kind: gaussian, standard_deviation: 1.0}
sampling:    {kind: regular, interval: 0.05, samples: [1000, 4000]}
noise:       {kind: arma, numerator: [1], denominator: [1, -0.5], innovation_variance: 0.02}
estimators:
  additive:  {kind: additive_srivc, terms: [{poles: 2, zeros: 0}, {poles: 2, zeros: 0}]}
  srivc:     {kind: srivc, poles: 4, zeros: 2}
starts:      {parameters: {relative_uniform: 0.05}}
monte_carlo: {runs: 40, seed: 7}
"""


def plan_of(text, tmp_path):
    file = tmp_path / "experiment.yaml"
    file.write_text(text, encoding="utf-8")
    return build_plan(load_spec(file))


def estimate(parameters, standard_errors=None, status="CONVERGED", **more):
    """Return the result of a worker."""
    failed = status == "FAILED"
    return {
        "status": status,
        "message": "",
        "start_delay": None,
        "delay": None if failed else 0.0,
        "numerator": None if failed else [1.0],
        "denominator": None if failed else [1.0, 1.0],
        "parameters": parameters,
        "standard_errors": standard_errors,
        "covariance": "white",
        "cost": 0.1,
        "fit_percent": None if failed else 90.0,
        "validation_fit_percent": None,
        "iterations": 7,
        "condition_number": 10.0,
    } | more


def results_of(plan, found, folder):
    """Return results from those of workers: ``found[estimator name, samples]`` is a list by replicate."""
    manifest = plan.manifest()
    start = next(point.label for point in plan.starts)
    results = {}
    for part in plan.estimators:
        for cell in plan.data_cells:
            for replicate, value in enumerate(found.get((part.name, cell.source.sampling.samples), ())):
                if value is not None:
                    results[Key(cell.hash, replicate, part.hash, start)] = value
    return Results(folder, MadeResults(manifest, results))


def ideal_results(plan, folder, *, bias=None, width=None, seed=1):
    """Return estimates with the theoretical variances; all estimators of a data set have the same errors.

    ``bias`` maps names of estimators to their bias in standard deviations by parameter, ``width`` to a factor of their
    standard errors.
    """
    variances = long_record_variances(plan)
    truth = true_values(plan.manifest()["data_cells"][0])
    del truth["delay"]
    rng = np.random.default_rng(seed)
    found = {}
    for k, cell in enumerate(plan.data_cells):
        samples = cell.source.sampling.samples
        common = rng.standard_normal((plan.runs, len(truth)))
        for j, part in enumerate(plan.estimators):
            # Without a theory: one per cent at this number of samples.
            theory = variances.get((k, j)) or {n: 1e-4 * v**2 * samples for n, v in truth.items()}
            deviation = np.array([np.sqrt(theory[name] / samples) for name in truth])
            own = 0.95 * common + np.sqrt(1 - 0.95**2) * rng.standard_normal(common.shape)
            shift = np.array([(bias or {}).get(part.name, {}).get(name, 0.0) for name in truth])
            values = np.array([*truth.values()]) + deviation * (own + shift)
            errors = dict(zip(truth, (width or {}).get(part.name, 1.0) * deviation, strict=True))
            found[part.name, samples] = [
                estimate(dict(zip(truth, map(float, row), strict=True)), errors, fit_percent=99.9999) for row in values
            ]
    return results_of(plan, found, folder)
