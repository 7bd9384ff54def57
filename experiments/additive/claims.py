"""Claims on the study's results: theory for long records, and the claims of the paper."""

from collections.abc import Iterator

import numpy as np
import pandas as pd

from ctid_cli.reporting.results import Results
from ctid_cli.reporting.study import last_part
from ctid_cli.studies.claims import Claim, within

from .measures import REFERENCE, errors_of, groups_of, is_misused, mse_ratio

#: Number of samples from which the limit for long records is expected to hold.
LONG = 20_000
#: Admitted N times the mean-square error over its limit: 300 runs determine it to 8 %.
NEAR_THEORY = (0.75, 1.3)
#: Largest bias in standard deviations of one estimate: 300 runs determine it to 0.06.
BIAS = 0.2
#: Percentage of all points that must lie within the limits: of so large a number, some exceed them by chance.
SHARE = 97.0
#: Points compared with theory: description, endings of their parameters' names, and whether they decide.
POINTS = {
    "open-loop": (("points of the figure", "_b0", True), ("points of all parameters", "", False)),
    "closed-loop": (("points of the figure", "", True),),
}
#: Mean-square error of another estimator over that of the sum of submodels: experiment, estimator, parameter, band.
#: Parameters whose ratio by theory exceeds 1 by less than a tenth are left out: a few hundred runs cannot resolve it.
RATIOS = {
    ("open-loop", "srivc", "g2_b0"): (1.1, 1.6),
    ("open-loop", "srivc", "g3_b0"): (1.05, 1.45),
    ("closed-loop", "clsrivc", "g1_a2"): (1.8, 3.2),
    ("closed-loop", "clsrivc", "g2_a2"): (1.25, 2.0),
    ("closed-loop", "clsrivc", "g2_b0"): (1.05, 1.35),
}
#: Least percentage that converges: experiment, estimator, lower and upper limit of the number of samples, percentage.
CONVERGENCE = (
    ("open-loop", "additive", 0, np.inf, 100.0),
    ("open-loop", "srivc", 0, 7000, 95.0),
    ("open-loop", "srivc", 7000, np.inf, 100.0),
    ("closed-loop", "additive", 0, np.inf, 99.0),
    ("closed-loop", "clsrivc", 0, np.inf, 99.0),
    ("closed-loop", "srivc", 0, np.inf, 99.0),
)
#: With coloured noise in closed loop: least bias of the direct estimator in standard deviations of one estimate, and
#: largest bias of the estimators with closed-loop instruments in standard errors of the mean.
BIASED, UNBIASED = 3.0, 3.3
#: Accepted coverage [%], and the number of parameters that may lie outside.
COVERAGE, OUTSIDE = (93.0, 97.0), 1
#: Simulated beam: error of the output over the noise, relative error of a frequency, and the required percentage.
NOISE_FLOOR, FREQUENCY, BEAM_SHARE, BEAM_ITERATIONS = 1.2, 1e-5, 90.0, 12


def errors_are_those_of_theory(results: Results) -> Iterator[Claim]:
    """Test N times the mean-square error against theory, for the parameters of the figure and for all."""
    low, high = NEAR_THEORY
    errors = errors_of(results).query("samples >= @LONG").dropna(subset="ratio")
    for what, names, decides in POINTS[last_part(results.experiment)]:
        ratios = errors.loc[errors["parameter"].str.endswith(names), "ratio"]
        if len(ratios):
            inside = 100 * ratios.between(low, high).mean()
            yield Claim(
                f"{what}, N >= {LONG}: N MSE / theory within {low:g} to {high:g}",
                f"{inside:.1f} % of {len(ratios)}; {ratios.min():.3f} to {ratios.max():.3f}, mean {ratios.mean():.3f}",
                f"{SHARE:g} %" if decides else "",
                bool(inside >= SHARE) if decides else None,
            )


def estimates_are_unbiased(results: Results) -> Iterator[Claim]:
    """Test biases for long records."""
    errors = errors_of(results).query("samples >= @LONG").dropna(subset="bias_per_deviation").reset_index(drop=True)
    if len(errors):
        biases = errors["bias_per_deviation"].abs()
        worst, inside = errors.loc[biases.idxmax()], 100 * (biases < BIAS).mean()
        at = f"{biases.max():.3f} ({worst['estimator']}, {worst['parameter']}, N = {worst['samples']})"
        yield Claim(
            f"points of all parameters, N >= {LONG}: bias below {BIAS:g} standard deviations of one estimate",
            f"{inside:.1f} % of {len(errors)}; at most {at}",
            f"{SHARE:g} %",
            bool(inside >= SHARE),
        )


def submodels_have_the_least_errors(results: Results) -> Iterator[Claim]:
    """Compare the errors of other estimators with those of the sum of submodels."""
    errors = errors_of(results).query("samples >= @LONG")
    theory = errors.groupby(["estimator", "parameter"], sort=False)["theory"].first()
    for (estimator, parameter), own in theory.items():
        if estimator == REFERENCE or REFERENCE not in theory:
            continue
        ratio, _ = mse_ratio(results, estimator, parameter, errors["samples"].unique())
        expected = own / theory[REFERENCE, parameter]
        band = RATIOS.get((last_part(results.experiment), estimator, parameter))
        yield Claim(
            f"MSE of {estimator} / MSE of additive, {parameter}, N >= {LONG} together",
            f"{ratio.value:.3f} ± {ratio.error or 0.0:.3f}{f'; theory {expected:.3f}' if expected == expected else ''}",
            f"{band[0]:g} to {band[1]:g}" if band else "",
            band[0] <= ratio.value <= band[1] if band else None,
        )


def estimates_converge(results: Results) -> Iterator[Claim]:
    """Test the percentage of converged estimates, at the number of samples where it is least."""
    every = groups_of(results)
    every = every.assign(lost=every["failed"] + every["not_converged"]).sort_values("samples", kind="stable")
    every["share"] = 100 * (1 - every["lost"] / every["runs"])
    for at, estimator, least, below, percent in CONVERGENCE:
        groups = every[(every["estimator"] == estimator) & (every["samples"] >= least) & (every["samples"] < below)]
        if at != last_part(results.experiment) or groups.empty:
            continue
        worst, sums = groups.loc[groups["share"].idxmin()], groups[["lost", "runs", "valueless"]].sum()
        yield Claim(
            f"{estimator} converges, N from {groups['samples'].min()} to {groups['samples'].max()}",
            f"at least {worst['share']:.2f} % (N = {worst['samples']}); all but {sums['lost']} of {sums['runs']}; "
            f"without a value {sums['valueless']}",
            f"{percent:g} %",
            bool(worst["share"] >= percent),
        )


def feedback_biases_direct_instruments(results: Results) -> Iterator[Claim]:
    """Test which estimators are biased if feedback brings coloured noise into the input."""
    for row in errors_of(results).dropna(subset=["bias_per_deviation", "bias_per_error"]).itertuples():
        measured = f"{row.bias_per_deviation:+.2f} deviations of one estimate"
        measured += f", {row.bias_per_error:+.1f} standard errors"
        required, holds = "", None
        if row.estimator == "srivc" and row.parameter in ("g2_a1", "g2_b0"):
            required, holds = f"beyond {BIASED:g} deviations", abs(row.bias_per_deviation) > BIASED
        elif row.estimator in (REFERENCE, "clsrivc"):
            required, holds = f"within {UNBIASED:g} standard errors", abs(row.bias_per_error) <= UNBIASED
        yield Claim(f"bias of {row.estimator}, {row.parameter}", measured, required, holds)


def beam_is_found(results: Results) -> Iterator[Claim]:
    """Test whether the simulated beam is found from the printed initial values."""
    floor = NOISE_FLOOR * 10 ** (-float(results.settings["noise"]["snr_db"]) / 10)
    estimates = results.estimates
    reached = estimates[(1 - estimates["fit_percent"] / 100) ** 2 < floor]
    shown, share = f"{len(reached)} of {len(estimates)} data sets", 100 * len(reached) / len(estimates)
    claim = f"squared output error below {NOISE_FLOOR:g} times that of the noise"
    yield Claim(claim, shown, f"{BEAM_SHARE:g} %", share >= BEAM_SHARE)
    if len(reached):
        median, required = float(reached["iterations"].median()), f"median {BEAM_ITERATIONS} at most"
        shown = f"median {median:g}, at most {reached['iterations'].max()}"
        yield Claim("iterations there", shown, required, median <= BEAM_ITERATIONS)
        found = results.errors[results.errors["replicate"].isin(reached["replicate"])]
        found = found[found["parameter"].str.endswith("_a2")]
        worst = float((np.sqrt(found["true"] / (found["true"] + found["value"])) - 1).abs().max())
        claim = "relative error of the natural frequencies there"
        yield within(claim, worst, high=FREQUENCY, shown=f"at most {worst:.1e}")


def _covered(results: Results) -> pd.Series:
    """Return the coverage of every parameter [%], by estimator."""
    return errors_of(results).dropna(subset="coverage").set_index("estimator")["coverage"]


def coverage_is_reported(results: Results) -> Iterator[Claim]:
    """Report the coverage of 95 % intervals by estimator; it is tested for both experiments together."""
    for estimator, percentages in _covered(results).groupby(level=0, sort=False):
        claim = f"coverage of 95 % intervals, {estimator}{' (misused)' if is_misused(results, estimator) else ''}"
        yield Claim(claim, f"{percentages.min():.1f} to {percentages.max():.1f} %")


def intervals_cover(*experiments: Results) -> Iterator[Claim]:
    """Test the coverage for the noise that the formula assumes, over all experiments."""
    found = pd.concat(
        [own for one in experiments for name, own in _covered(one).groupby(level=0) if not is_misused(one, name)]
    )
    if len(found):
        outside = int((~found.between(*COVERAGE)).sum())
        claim = "coverage outside {:g} to {:g} %, formula as it should be".format(*COVERAGE)
        yield within(claim, outside, high=OUTSIDE, shown=f"{outside} of {len(found)} parameters")
