"""Does a reproduction agree with theory and with the claims of the paper?

python -m experiments.additive.acceptance --results results
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ctid_cli.reporting.layout import markdown_table, text_table
from ctid_cli.reporting.parameter_errors import (
    ParameterErrors,
    ParameterEstimates,
    mse_ratio,
    parameter_errors,
    parameter_estimates,
)
from ctid_cli.reporting.results import Results, find_results

#: From so many samples on the limit for long records is expected to hold.
LONG = 20_000
#: Where N times the mean-square error lies, as a multiple of the limit: 300 runs know it to 8 %.
NEAR_THEORY = (0.75, 1.3)
#: Largest bias in standard deviations of one estimate: 300 runs know it to 0.06.
BIAS = 0.2
#: Percentage of all points that must lie there: so many points have some that do not, by chance.
SHARE = 97.0
#: Mean-square error of another estimator over that of the sum of submodels: experiment, estimator, parameter, band.
#: Parameters where theory says less than a tenth are left out: a few hundred runs cannot tell.
RATIOS = (
    ("open-loop", "srivc", "g2_b0", 1.1, 1.6),
    ("open-loop", "srivc", "g3_b0", 1.05, 1.45),
    ("closed-loop", "clsrivc", "g1_a2", 1.8, 3.2),
    ("closed-loop", "clsrivc", "g2_a2", 1.25, 2.0),
    ("closed-loop", "clsrivc", "g2_b0", 1.05, 1.35),
)
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


@dataclass(frozen=True)
class Check:
    """One thing that must hold.

    Parameters
    ----------
    experiment, claim : str
        Where, and what.
    measured, required : str
        In words and numbers.
    passed : bool or None
        None for what is only reported.
    """

    experiment: str
    claim: str
    measured: str
    required: str = ""
    passed: bool | None = None

    @property
    def cells(self) -> list[str]:
        """The check as a line of a table."""
        verdict = {True: "yes", False: "NO", None: ""}[self.passed]
        return [self.experiment, self.claim, self.measured, self.required, verdict]


@dataclass(frozen=True, eq=False)
class Found:
    """What one experiment found.

    Parameters
    ----------
    name : str
        Last part of its name.
    results : Results
        Its results.
    estimates : list of ParameterEstimates
        The same by estimator and number of samples.
    errors : list of ParameterErrors
        Errors of these.
    """

    name: str
    results: Results
    estimates: list[ParameterEstimates]
    errors: list[ParameterErrors]


def read_study(results: Path) -> dict[str, Found]:
    """The experiments that were run.

    Parameters
    ----------
    results : Path
        Results folder.

    Returns
    -------
    dict
        By the last part of the experiment's name, in the order of the study.
    """
    study = {}
    for name in EXPERIMENTS:
        found = find_results(results, f"additive/{name}")
        if found is not None:
            estimates = parameter_estimates(found)
            study[name] = Found(name, found, estimates, parameter_errors(estimates))
    return study


def acceptance(study: Mapping[str, Found]) -> list[Check]:
    """All checks.

    Parameters
    ----------
    study : mapping of str to Found
        From `read_study`.

    Returns
    -------
    list of Check
        One that failed for every experiment that was not run.
    """
    checks = []
    for name, rules in EXPERIMENTS.items():
        if name in study:
            checks += [check for rule in rules for check in rule(study[name])]
        else:
            checks.append(Check(name, "was run", "no", "yes", False))
    return [*checks, *together_covered([study[name] for name in COVERING if name in study])]


def theory_checks(found: Found) -> Iterator[Check]:
    """N times the mean-square error against theory, and biases, where records are long."""
    name, long = found.name, [row for row in found.errors if row.samples >= LONG]
    low, high = NEAR_THEORY
    shown = [row for row in long if row.parameter.endswith("_b0")] if name == "open-loop" else long
    for chosen, what, decides in ((shown, "points of the figure", True), (long, "points of all parameters", False)):
        if not decides and chosen == shown:
            continue
        ratios = np.array([row.ratio for row in chosen if row.ratio is not None])
        if not ratios.size:
            continue
        inside = 100 * float(np.mean((ratios >= low) & (ratios <= high)))
        yield Check(
            name,
            f"{what}, N >= {LONG}: N MSE / theory within {low:g} to {high:g}",
            f"{inside:.1f} % of {ratios.size}; {ratios.min():.3f} to {ratios.max():.3f}, mean {ratios.mean():.3f}",
            f"{SHARE:g} %" if decides else "",
            bool(inside >= SHARE) if decides else None,
        )
    biases = [(abs(row.bias_per_deviation), row) for row in long if row.bias_per_deviation is not None]
    if biases:
        largest, worst = max(biases, key=lambda pair: pair[0])
        inside = 100 * float(np.mean([bias < BIAS for bias, _ in biases]))
        yield Check(
            name,
            f"points of all parameters, N >= {LONG}: bias below {BIAS:g} standard deviations of one estimate",
            f"{inside:.1f} % of {len(biases)}; at most {largest:.3f} ({worst.estimator}, {worst.parameter}, "
            f"N = {worst.samples})",
            f"{SHARE:g} %",
            inside >= SHARE,
        )


def ratio_checks(found: Found) -> Iterator[Check]:
    """How much larger the errors of other estimators are."""
    name, groups = found.name, [group for group in found.estimates if group.samples >= LONG]
    by_name: dict[str, list[ParameterEstimates]] = {}
    for group in groups:
        by_name.setdefault(group.estimator, []).append(group)
    reference = by_name.pop("additive", [])
    if not reference:
        return
    bands = {(estimator, parameter): (low, high) for at, estimator, parameter, low, high in RATIOS if at == name}
    for estimator, others in by_name.items():
        for k, parameter in enumerate(reference[0].names):
            ratio = mse_ratio(others, reference, parameter)
            theory = [group.theory for group in (others[0], reference[0])]
            expected = f"; theory {theory[0][k] / theory[1][k]:.3f}" if all(x is not None for x in theory) else ""
            band = bands.get((estimator, parameter))
            yield Check(
                name,
                f"MSE of {estimator} / MSE of additive, {parameter}, N >= {LONG} together",
                f"{ratio.ratio:.3f} ± {ratio.standard_error:.3f}{expected}",
                f"{band[0]:g} to {band[1]:g}" if band else "",
                band[0] <= ratio.ratio <= band[1] if band else None,
            )


def convergence_checks(found: Found) -> Iterator[Check]:
    """How many estimates converged, at the number of samples where fewest did."""
    name = found.name
    for at, estimator, least, below, percent in CONVERGENCE:
        groups = [g for g in found.estimates if g.estimator == estimator and least <= g.samples < below]
        if at != name or not groups:
            continue
        shares = [100 * (1 - (g.failed + g.not_converged) / g.runs) for g in groups]
        worst = int(np.argmin(shares))
        lost = sum(g.failed + g.not_converged for g in groups)
        valueless = sum(int(np.isnan(g.values).any(axis=1).sum()) for g in groups)
        yield Check(
            name,
            f"{estimator} converges, N from {groups[0].samples} to {groups[-1].samples}",
            f"at least {shares[worst]:.2f} % (N = {groups[worst].samples}); all but {lost} of "
            f"{sum(g.runs for g in groups)}; without a value {valueless}",
            f"{percent:g} %",
            shares[worst] >= percent,
        )


def coloured_checks(found: Found) -> Iterator[Check]:
    """Who is biased where feedback brings coloured noise into the input."""
    name = found.name
    for row in found.errors:
        if row.bias_per_deviation is None or row.bias_per_error is None:
            continue
        measured = (
            f"{row.bias_per_deviation:+.2f} deviations of one estimate, {row.bias_per_error:+.1f} standard errors"
        )
        required, passed = "", None
        if row.estimator == "srivc" and row.parameter in ("g2_a1", "g2_b0"):
            required = f"beyond {BIASED:g} deviations"
            passed = abs(row.bias_per_deviation) > BIASED
        elif row.estimator in ("additive", "clsrivc"):
            required = f"within {UNBIASED:g} standard errors"
            passed = abs(row.bias_per_error) <= UNBIASED
        yield Check(name, f"bias of {row.estimator}, {row.parameter}", measured, required, passed)


def beam_checks(found: Found) -> Iterator[Check]:
    """Whether the simulated beam is found from the printed initial values."""
    name, results, (group,) = found.name, found.results, found.estimates
    snr = float(results.settings["noise"]["snr_db"])
    reached = [
        row["fit_percent"] is not None and (1 - row["fit_percent"] / 100) ** 2 < NOISE_FLOOR * 10 ** (-snr / 10)
        for row in results.rows
    ]
    share = 100 * float(np.mean(reached))
    yield Check(
        name,
        f"squared output error below {NOISE_FLOOR:g} times that of the noise",
        f"{sum(reached)} of {len(reached)} data sets",
        f"{BEAM_SHARE:g} %",
        share >= BEAM_SHARE,
    )
    iterations = [row["iterations"] for row, there in zip(results.rows, reached, strict=True) if there]
    if iterations:
        median = float(np.median(iterations))
        yield Check(
            name,
            "iterations there",
            f"median {median:g}, at most {max(iterations)}",
            f"median {BEAM_ITERATIONS} at most",
            median <= BEAM_ITERATIONS,
        )
    squares = [k for k, parameter in enumerate(group.names) if parameter.endswith("_a2")]
    values = group.values[np.array(reached) & np.isfinite(group.values).all(axis=1)][:, squares]
    if values.size:
        worst = float(np.max(np.abs(np.sqrt(group.truth[squares] / values) - 1)))
        yield Check(
            name,
            "relative error of the natural frequencies there",
            f"at most {worst:.1e}",
            f"{FREQUENCY:g} at most",
            worst <= FREQUENCY,
        )


def covered(found: Found) -> dict[str, list[float]]:
    """Coverage of every parameter [%], by estimator."""
    by_estimator: dict[str, list[float]] = {}
    for row in found.errors:
        if row.coverage is not None:
            by_estimator.setdefault(row.estimator, []).append(row.coverage)
    return by_estimator


def is_misused(found: Found, estimator: str) -> bool:
    """Whether an estimator takes coloured noise for white."""
    settings = found.results.settings
    return bool(settings["noise"]["kind"] != "white" and settings["estimators"][estimator]["covariance"] == "white")


def coverage_checks(found: Found) -> Iterator[Check]:
    """Coverage of 95 % intervals, reported; it is judged over both experiments together."""
    for estimator, percentages in covered(found).items():
        claim = f"coverage of 95 % intervals, {estimator}{' (misused)' if is_misused(found, estimator) else ''}"
        yield Check(found.name, claim, f"{min(percentages):.1f} to {max(percentages):.1f} %")


def together_covered(experiments: Sequence[Found]) -> Iterator[Check]:
    """Coverage where the formula is the right one, over all experiments."""
    low, high = COVERAGE
    found = [
        percentage
        for item in experiments
        for estimator, percentages in covered(item).items()
        if not is_misused(item, estimator)
        for percentage in percentages
    ]
    if found:
        outside = sum(not low <= percentage <= high for percentage in found)
        yield Check(
            " and ".join(item.name for item in experiments),
            f"coverage outside {low:g} to {high:g} %, formula as it should be",
            f"{outside} of {len(found)} parameters",
            f"{OUTSIDE} at most",
            outside <= OUTSIDE,
        )


#: Experiments on coverage.
COVERING = ("coverage-open-loop", "coverage-closed-loop")
#: What is asked of each experiment.
EXPERIMENTS: dict[str, tuple[Callable[[Found], Iterator[Check]], ...]] = {
    "open-loop": (theory_checks, ratio_checks, convergence_checks),
    "closed-loop": (theory_checks, ratio_checks, convergence_checks),
    "closed-loop-coloured": (coloured_checks,),
    "coverage-open-loop": (coverage_checks,),
    "coverage-closed-loop": (coverage_checks,),
    "flexible-beam": (beam_checks,),
}
HEADER = ["experiment", "what", "measured", "required", "holds"]


def write(checks: Sequence[Check], style: str = "text") -> str:
    """Checks as a table, ``text`` or ``md``."""
    table = text_table if style == "text" else markdown_table
    return table(HEADER, [check.cells for check in checks], "lllll")


def main(arguments: Sequence[str] | None = None) -> None:
    """Print all checks; exit code 1 if one does not hold."""
    parser = argparse.ArgumentParser(description="Check a reproduction of the study of additive models.")
    parser.add_argument("--results", type=Path, default=Path("results"))
    checks = acceptance(read_study(parser.parse_args(arguments).results))
    failed = [check for check in checks if check.passed is False]
    judged = sum(check.passed is not None for check in checks)
    sys.stdout.write(f"{write(checks)}\n\n{judged - len(failed)} of {judged} hold\n")
    if failed:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
