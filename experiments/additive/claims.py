"""What must hold of the study's results: theory for long records, and the claims of the paper."""

from collections.abc import Iterator

import numpy as np

from ctid_cli.reporting.results import Results
from ctid_cli.studies.catalogue import last_part
from ctid_cli.studies.claims import Claim, within

from .measures import by_estimator, errors_of, is_misused, mse_ratio

#: From so many samples on the limit for long records is expected to hold.
LONG = 20_000
#: Where N times the mean-square error lies, as a multiple of the limit: 300 runs know it to 8 %.
NEAR_THEORY = (0.75, 1.3)
#: Largest bias in standard deviations of one estimate: 300 runs know it to 0.06.
BIAS = 0.2
#: Percentage of all points that must lie there: so many points have some that do not, by chance.
SHARE = 97.0
#: Points that are compared with theory: what they are, how their parameters end, and whether they decide.
POINTS = {
    "open-loop": (("points of the figure", "_b0", True), ("points of all parameters", "", False)),
    "closed-loop": (("points of the figure", "", True),),
}
#: Mean-square error of another estimator over that of the sum of submodels: experiment, estimator, parameter, band.
#: Parameters where theory says less than a tenth are left out: a few hundred runs cannot tell.
RATIOS = {
    ("open-loop", "srivc", "g2_b0"): (1.1, 1.6),
    ("open-loop", "srivc", "g3_b0"): (1.05, 1.45),
    ("closed-loop", "clsrivc", "g1_a2"): (1.8, 3.2),
    ("closed-loop", "clsrivc", "g2_a2"): (1.25, 2.0),
    ("closed-loop", "clsrivc", "g2_b0"): (1.05, 1.35),
}
#: Least percentage that converges: experiment, estimator, numbers of samples from and below, percentage.
CONVERGENCE = (
    ("open-loop", "additive", 0, np.inf, 100.0),
    ("open-loop", "srivc", 0, 7000, 95.0),
    ("open-loop", "srivc", 7000, np.inf, 100.0),
    ("closed-loop", "additive", 0, np.inf, 99.0),
    ("closed-loop", "clsrivc", 0, np.inf, 99.0),
    ("closed-loop", "srivc", 0, np.inf, 99.0),
)
#: Under coloured noise in closed loop: least bias of the direct estimator in standard deviations of one estimate, and
#: largest one of the estimators with closed-loop instruments in standard errors of the mean.
BIASED, UNBIASED = 3.0, 3.3
#: Coverage [%] that counts as right, and how many of all parameters may lie outside.
COVERAGE, OUTSIDE = (93.0, 97.0), 1
#: The simulated beam: error of the output over the noise, relative error of a frequency, and how many must do.
NOISE_FLOOR, FREQUENCY, BEAM_SHARE, BEAM_ITERATIONS = 1.2, 1e-5, 90.0, 12


def errors_are_those_of_theory(results: Results) -> Iterator[Claim]:
    """N times the mean-square error against theory: of the parameters that the figure shows, and of all."""
    low, high = NEAR_THEORY
    for what, names, decides in POINTS[last_part(results.experiment)]:
        rows = [row for row in errors_of(results) if row.samples >= LONG and row.parameter.endswith(names)]
        ratios = np.array([row.ratio for row in rows if row.ratio is not None])
        if ratios.size:
            inside = 100 * float(np.mean((ratios >= low) & (ratios <= high)))
            yield Claim(
                f"{what}, N >= {LONG}: N MSE / theory within {low:g} to {high:g}",
                f"{inside:.1f} % of {ratios.size}; {ratios.min():.3f} to {ratios.max():.3f}, mean {ratios.mean():.3f}",
                f"{SHARE:g} %" if decides else "",
                bool(inside >= SHARE) if decides else None,
            )


def estimates_are_unbiased(results: Results) -> Iterator[Claim]:
    """Biases where records are long."""
    rows = [row for row in errors_of(results) if row.samples >= LONG and row.bias_per_deviation is not None]
    if rows:
        worst = max(rows, key=lambda row: abs(row.bias_per_deviation))
        inside = 100 * float(np.mean([abs(row.bias_per_deviation) < BIAS for row in rows]))
        at = f"{abs(worst.bias_per_deviation):.3f} ({worst.estimator}, {worst.parameter}, N = {worst.samples})"
        yield Claim(
            f"points of all parameters, N >= {LONG}: bias below {BIAS:g} standard deviations of one estimate",
            f"{inside:.1f} % of {len(rows)}; at most {at}",
            f"{SHARE:g} %",
            inside >= SHARE,
        )


def submodels_have_the_least_errors(results: Results) -> Iterator[Claim]:
    """How much larger the errors of other estimators are."""
    groups = by_estimator(results, LONG)
    reference = groups.pop("additive", [])
    for estimator, others in groups.items() if reference else ():
        for k, parameter in enumerate(reference[0].names):
            ratio, _ = mse_ratio(others, reference, parameter)
            theory = [group.theory for group in (others[0], reference[0])]
            expected = f"; theory {theory[0][k] / theory[1][k]:.3f}" if all(x is not None for x in theory) else ""
            band = RATIOS.get((last_part(results.experiment), estimator, parameter))
            yield Claim(
                f"MSE of {estimator} / MSE of additive, {parameter}, N >= {LONG} together",
                f"{ratio.value:.3f} ± {ratio.error or 0.0:.3f}{expected}",
                f"{band[0]:g} to {band[1]:g}" if band else "",
                band[0] <= ratio.value <= band[1] if band else None,
            )


def estimates_converge(results: Results) -> Iterator[Claim]:
    """How many estimates converged, at the number of samples where fewest did."""
    for at, estimator, least, below, percent in CONVERGENCE:
        groups = [group for group in by_estimator(results).get(estimator, []) if least <= group.samples < below]
        if at != last_part(results.experiment) or not groups:
            continue
        shares = [100 * (1 - (group.failed + group.not_converged) / group.runs) for group in groups]
        worst = int(np.argmin(shares))
        lost = sum(group.failed + group.not_converged for group in groups)
        valueless = sum(int(np.isnan(group.values).any(axis=1).sum()) for group in groups)
        yield Claim(
            f"{estimator} converges, N from {groups[0].samples} to {groups[-1].samples}",
            f"at least {shares[worst]:.2f} % (N = {groups[worst].samples}); all but {lost} of "
            f"{sum(group.runs for group in groups)}; without a value {valueless}",
            f"{percent:g} %",
            shares[worst] >= percent,
        )


def feedback_biases_direct_instruments(results: Results) -> Iterator[Claim]:
    """Who is biased where feedback brings coloured noise into the input."""
    for row in errors_of(results):
        if row.bias_per_deviation is None or row.bias_per_error is None:
            continue
        measured = f"{row.bias_per_deviation:+.2f} deviations of one estimate"
        measured += f", {row.bias_per_error:+.1f} standard errors"
        required, holds = "", None
        if row.estimator == "srivc" and row.parameter in ("g2_a1", "g2_b0"):
            required, holds = f"beyond {BIASED:g} deviations", abs(row.bias_per_deviation) > BIASED
        elif row.estimator in ("additive", "clsrivc"):
            required, holds = f"within {UNBIASED:g} standard errors", abs(row.bias_per_error) <= UNBIASED
        yield Claim(f"bias of {row.estimator}, {row.parameter}", measured, required, holds)


def beam_is_found(results: Results) -> Iterator[Claim]:
    """Whether the simulated beam is found from the printed initial values."""
    floor = NOISE_FLOOR * 10 ** (-float(results.settings["noise"]["snr_db"]) / 10)
    reached = [r for r in results.rows if r["fit_percent"] is not None and (1 - r["fit_percent"] / 100) ** 2 < floor]
    shown, share = f"{len(reached)} of {len(results.rows)} data sets", 100 * len(reached) / len(results.rows)
    claim = f"squared output error below {NOISE_FLOOR:g} times that of the noise"
    yield Claim(claim, shown, f"{BEAM_SHARE:g} %", share >= BEAM_SHARE)
    if reached:
        iterations = [row["iterations"] for row in reached]
        median, required = float(np.median(iterations)), f"median {BEAM_ITERATIONS} at most"
        shown = f"median {median:g}, at most {max(iterations)}"
        yield Claim("iterations there", shown, required, median <= BEAM_ITERATIONS)
        truth = {row.parameter: row.true for row in errors_of(results) if row.parameter.endswith("_a2")}
        errors = [np.sqrt(true / row["parameters"][name]) - 1 for row in reached for name, true in truth.items()]
        worst, claim = float(np.max(np.abs(errors))), "relative error of the natural frequencies there"
        yield within(claim, worst, high=FREQUENCY, shown=f"at most {worst:.1e}")


def _covered(results: Results) -> dict[str, list[float]]:
    """Coverage of every parameter [%], by estimator."""
    percentages: dict[str, list[float]] = {}
    for row in errors_of(results):
        if row.coverage is not None:
            percentages.setdefault(row.estimator, []).append(row.coverage)
    return percentages


def coverage_is_reported(results: Results) -> Iterator[Claim]:
    """Coverage of 95 % intervals by estimator; it is judged over both experiments together."""
    for estimator, percentages in _covered(results).items():
        claim = f"coverage of 95 % intervals, {estimator}{' (misused)' if is_misused(results, estimator) else ''}"
        yield Claim(claim, f"{min(percentages):.1f} to {max(percentages):.1f} %")


def intervals_cover(*experiments: Results) -> Iterator[Claim]:
    """Coverage where the formula is the right one, over all experiments."""
    low, high = COVERAGE
    found = [
        percentage
        for results in experiments
        for estimator, percentages in _covered(results).items()
        if not is_misused(results, estimator)
        for percentage in percentages
    ]
    if found:
        outside = sum(not low <= percentage <= high for percentage in found)
        claim = f"coverage outside {low:g} to {high:g} %, formula as it should be"
        yield within(claim, outside, high=OUTSIDE, shown=f"{outside} of {len(found)} parameters")
