"""Common measures of the tables and the claims: errors, their ratios, and misused standard errors.

Columns of errors
-----------------
- ``experiment``, ``estimator``, ``samples``; ``parameter`` and its ``true`` value; ``runs``, ``failed``,
  ``not_converged``; ``counted``: those with a value. Errors are in the unit of the parameter.
- ``mse``; ``n_mse``: times the number of samples; ``theory``: its limit; ``ratio`` of the two with its
  standard error ``ratio_error`` for the number of data sets [-].
- ``bias``; ``deviation``, the standard deviation of one estimate; ``bias_per_deviation``; ``bias_per_error``: in
  standard errors of the mean, whether there is a bias at all.
- ``with_error``: estimates with a standard error; ``covered``: those whose 95 % interval holds the true value;
  ``coverage`` of the counted ones with its 95 % Wilson interval ``low`` and ``high`` [%]; ``error_ratio``: root mean
  square of the standard errors over the standard deviation of the estimates.
"""

from collections.abc import Sequence
from functools import cache

import numpy as np
import pandas as pd

from ctid_cli.errors import UsageError
from ctid_cli.inference import monte_carlo
from ctid_cli.inference.monte_carlo import Measured, Sample
from ctid_cli.reporting.measures import measure_frame
from ctid_cli.reporting.results import Results, lookup
from ctid_cli.running.theory import long_record_variances

#: Estimator with which others are compared.
REFERENCE = "additive"
MEASURES = ("mse", "bias", "deviation", "coverage", "error_ratio")
#: Columns that identify the errors of one parameter in one data cell.
GROUP = ["group", "parameter"]


@cache
def groups_of(results: Results) -> pd.DataFrame:
    """Return estimator and number of samples of each group, and the number of its unsuccessful estimates."""
    cells, parts = results.manifest["data_cells"], results.manifest["estimators"]
    groups = results.groups.rename(columns={"estimator": "place"})
    groups["samples"] = [int(lookup(cells[k]["content"], "sampling.samples") or 0) for k in groups["cell"]]
    groups["estimator"] = [parts[k]["name"] for k in groups["place"]]
    stored, valueless = results.stored, results.errors.assign(none=results.errors["value"].isna())
    status = pd.DataFrame({"runs": 1, "failed": stored.failures, "not_converged": stored.column("status")})
    status["not_converged"] = (status["not_converged"] != b"CONVERGED") & ~status["failed"]
    groups = groups.join(status.groupby(results.numbers).sum(), how="inner")
    groups["valueless"] = valueless.groupby(["group", "replicate"])["none"].any().groupby("group").sum()
    return groups.sort_values(["place", "cell"])


@cache
def errors_of(results: Results) -> pd.DataFrame:
    """Return the errors of each parameter of a sum of submodels, by estimator and number of samples."""
    if len(results.stored) and "additive" not in (results.manifest["data_cells"][0]["content"].get("system") or {}):
        wanted = "errors of parameters need data that are simulated from a sum of submodels (system: additive)"
        raise UsageError(f"{results.experiment}: {wanted}")
    errors, groups = results.errors, groups_of(results)
    counts = errors[[*GROUP, "true"]].assign(counted=errors["value"].notna())
    counts["with_error"] = counts["counted"] & errors["standard_error"].notna()
    counts["covered"] = monte_carlo.covered(
        Sample(errors["value"], errors["standard_error"], quantiles=errors["quantile"])
    )
    sums = dict.fromkeys(("counted", "with_error", "covered"), "sum")
    frame = counts.groupby(GROUP, sort=False).agg({"true": "first"} | sums)
    measured = measure_frame(results, MEASURES).set_index(["parameter", "measure"], append=True)
    found = measured[[*Measured._fields]].unstack("measure").reindex(frame.index)
    errors_of_measures = found["error"][["mse", "bias"]].add_suffix("_error")
    frame = frame.join(found["value"]).join(errors_of_measures)
    frame = frame.assign(low=found["low", "coverage"], high=found["high", "coverage"], experiment=results.experiment)
    frame = groups.merge(frame.reset_index(), left_index=True, right_on="group").reset_index(drop=True)
    limits = {} if results.plan is None else long_record_variances(results.plan)
    places = frame[["cell", "place", "parameter"]].itertuples(index=False, name=None)
    frame["theory"] = [limits.get((cell, place), {}).get(name, np.nan) for cell, place, name in places]
    frame["n_mse"] = frame["samples"] * frame["mse"]
    frame["ratio"] = frame["n_mse"] / frame["theory"]
    frame["ratio_error"] = frame["samples"] * frame["mse_error"] / frame["theory"]
    frame["bias_per_deviation"] = frame["bias"] / frame["deviation"].replace(0.0, np.nan)
    frame["bias_per_error"] = frame["bias"] / frame["bias_error"].replace(0.0, np.nan)
    return frame


def mse_ratio(results: Results, estimator: str, parameter: str, samples: Sequence[int]) -> tuple[Measured, int]:
    """Return the mean-square error of an estimator over that of the sum of submodels, and the data sets of both.

    Both estimators see the same noise, so their errors are correlated, and the ratio is more accurate than either
    error. Longer records begin with the shorter ones of the same data set, so these errors are correlated too: the
    jackknife leaves out a data set at all its lengths.
    """
    errors = results.errors[results.errors["parameter"] == parameter]
    errors = errors.merge(groups_of(results)[["estimator", "samples"]], left_on="group", right_index=True)
    errors = errors[errors["samples"].isin(samples)]
    # N times the squared error by data set, if all lengths of both estimators have one.
    errors["square"] = errors["samples"] * errors["value"] ** 2
    squares = errors.pivot(index="replicate", columns=["estimator", "samples"], values="square")
    known = squares[[estimator, REFERENCE]].dropna()
    if len(known) < 2:
        both = f"{results.experiment}: {estimator} and {REFERENCE}"
        raise UsageError(f"{both} have {len(known)} estimates on the same data sets, too few for a ratio")
    sums = (known[name].sum(axis=1).to_numpy() for name in (estimator, REFERENCE))
    return monte_carlo.of_means(lambda one, other, _: one / other, *sums), len(known)


def parameters(results: Results) -> list[str]:
    """Return the names of the parameters."""
    return list(errors_of(results)["parameter"].unique())


def is_misused(results: Results, estimator: str) -> bool:
    """Return whether an estimator assumes white noise although it is coloured."""
    settings = results.settings
    return bool(settings["noise"]["kind"] != "white" and settings["estimators"][estimator]["covariance"] == "white")


def ratios(results: Results) -> pd.DataFrame:
    """Return mean-square errors of other estimators over those of the sum of submodels, if theory gives both."""
    known = errors_of(results).dropna(subset="theory")
    reference = known[known["estimator"] == REFERENCE].set_index(["samples", "parameter"])["theory"]
    rows = []
    for row in known[known["estimator"] != REFERENCE].itertuples():
        if (row.samples, row.parameter) not in reference.index:
            continue
        try:
            ratio, pairs = mse_ratio(results, row.estimator, row.parameter, [row.samples])
        except UsageError:
            continue
        theory = row.theory / reference[row.samples, row.parameter]
        place = (results.experiment, row.estimator, row.samples, row.parameter)
        rows.append((*place, pairs, ratio.value, ratio.error or 0.0, theory))
    columns = ["experiment", "estimator", "samples", "parameter", "pairs", "ratio", "standard_error", "theory"]
    return pd.DataFrame(rows, columns=columns)
