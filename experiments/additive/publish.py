"""Write a finished reproduction to results/published: tables, figures, checks, and the environment that made them.

python -m experiments.additive.publish --results results
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ctid_cli.errors import UsageError
from ctid_cli.reporting.layout import csv_text, markdown_table, number
from ctid_cli.reporting.parameter_errors import ParameterErrors, ParameterEstimates, mse_ratio
from ctid_cli.reporting.publication import copy_figures, environment
from experiments.additive.acceptance import COVERING, Found, acceptance, is_misused, read_study, write

#: Numbers of samples that the text shows, of all that were run.
SIZES = 6
#: Columns of errors.csv; standard errors are judged where the study asks for it, see coverage.csv.
ERRORS = (
    *("experiment", "estimator", "samples", "parameter", "true", "runs", "failed", "not_converged", "counted", "mse"),
    *("n_mse", "theory", "ratio", "ratio_error", "bias", "deviation", "bias_per_deviation", "bias_per_error"),
)
#: Columns of coverage.csv.
COVERAGE = (
    *("experiment", "estimator", "misused", "samples", "parameter", "runs", "counted", "with_error", "covered"),
    *("coverage", "low", "high", "error_ratio"),
)


def main(arguments: Sequence[str] | None = None) -> None:
    """Parse the command line and write."""
    parser = argparse.ArgumentParser(description="Publish a finished reproduction of the study of additive models.")
    parser.add_argument("--results", type=Path, default=Path("results"))
    parser.add_argument("--out", type=Path, default=Path("results/published/additive"))
    chosen = parser.parse_args(arguments)
    study = read_study(chosen.results)
    if not study:
        parser.error(f"there are no results of this study in {chosen.results}; run first: make reproduce-additive")
    chosen.out.mkdir(parents=True, exist_ok=True)
    errors = [rounded(row.as_dict()) for found in study.values() for row in found.errors]
    files = {
        "errors.csv": csv_text(errors, ERRORS),
        "ratios.csv": csv_text([rounded(row) for found in study.values() for row in ratios(found)]),
        "coverage.csv": csv_text(
            [rounded(row) for name in COVERING if name in study for row in coverage(study[name])], COVERAGE
        ),
        "unfinished.csv": csv_text([row for found in study.values() for row in unfinished(found)], UNFINISHED),
        "tables.md": tables(study),
        "acceptance.md": write(acceptance(study), "md") + "\n",
        "environment.json": environment(chosen.results, [f"additive/{name}" for name in study]),
    }
    for name, text in files.items():
        (chosen.out / name).write_text(text, encoding="utf-8")
    copy_figures(chosen.results / "additive_figures", chosen.out / "figures")


def rounded(row: Mapping[str, Any]) -> dict[str, Any]:
    """Numbers to 6 digits: the published files must not change with the last bit of a sum."""
    return {key: float(f"{value:.6g}") if isinstance(value, float) else value for key, value in row.items()}


def by_estimator(found: Found) -> dict[str, list[ParameterEstimates]]:
    """Estimates of each estimator by rising number of samples."""
    groups: dict[str, list[ParameterEstimates]] = {}
    for group in sorted(found.estimates, key=lambda group: group.samples):
        groups.setdefault(group.estimator, []).append(group)
    return groups


def ratios(found: Found) -> Iterator[dict[str, Any]]:
    """Mean-square errors of other estimators over those of the sum of submodels, where both are consistent."""
    groups = by_estimator(found)
    reference = groups.pop("additive", [])
    for estimator, others in groups.items():
        for other, own in zip(others, reference, strict=False):
            if other.theory is None or own.theory is None:
                continue
            for k, parameter in enumerate(own.names):
                try:
                    ratio = mse_ratio([other], [own], parameter)
                except UsageError:
                    continue
                yield {
                    "experiment": found.results.experiment,
                    "estimator": estimator,
                    "samples": own.samples,
                    "parameter": parameter,
                    "pairs": ratio.pairs,
                    "ratio": ratio.ratio,
                    "standard_error": ratio.standard_error,
                    "theory": float(other.theory[k] / own.theory[k]),
                }


def coverage(found: Found) -> Iterator[dict[str, Any]]:
    """How often 95 % intervals contain the truth."""
    for row in found.errors:
        yield row.as_dict() | {"misused": "yes" if is_misused(found, row.estimator) else "no"}


#: Columns of unfinished.csv.
UNFINISHED = ("experiment", "estimator", "samples", "replicate", "seed", "status", "id")


def unfinished(found: Found) -> Iterator[dict[str, Any]]:
    """Every estimate that failed or did not converge, with what makes it again."""
    samples = {cell["hash"]: cell["content"]["sampling"]["samples"] for cell in found.results.manifest["data_cells"]}
    for row in found.results.rows:
        if row["status"] != "CONVERGED":
            content = row | {"samples": samples[row["cell"]], "seed": found.results.manifest["seed"]}
            yield {name: content[name] for name in UNFINISHED}


def tables(study: Mapping[str, Found]) -> str:
    """What a reader wants to see, as Markdown."""
    parts = []
    titles = {
        "open-loop": "Open loop, section 6.1 (figure 3)",
        "closed-loop": "Closed loop, section 6.2 (figure 4)",
        "closed-loop-coloured": "Closed loop with coloured noise",
        "flexible-beam": "Flexible beam, SIMULATED stand-in (figure 6)",
    }
    for name, title in titles.items():
        if name not in study:
            continue
        found = study[name]
        parts += [f"### {title}", *convergence_table(found)]
        if name in ("open-loop", "closed-loop"):
            parts += ["N times the mean-square error; in brackets its ratio to theory.", error_table(found)]
            parts += ["Mean-square error over that of the sum of submodels, ± standard error.", *ratio_tables(found)]
        elif name == "closed-loop-coloured":
            parts += ["Bias in standard deviations of one estimate; in brackets in standard errors.", bias_table(found)]
        else:
            parts += ["Estimates and truth over all data sets.", beam_table(found)]
    if any(name in study for name in COVERING):
        parts += ["### Coverage of 95 % intervals [%]", coverage_table([study[n] for n in COVERING if n in study])]
    return "\n\n".join(parts) + "\n"


def some(sizes: Sequence[int]) -> list[int]:
    """A few numbers of samples, the least and the greatest among them."""
    ordered = sorted(set(sizes))
    return [ordered[k] for k in np.unique(np.linspace(0, len(ordered) - 1, SIZES).round().astype(int))]


def convergence_table(found: Found) -> list[str]:
    """Counts of estimates that are not as they should be; all that have a value count in the tables below."""
    rows = []
    for estimator, groups in by_estimator(found).items():
        runs = sum(group.runs for group in groups)
        failed = sum(group.failed for group in groups)
        stopped = sum(group.not_converged for group in groups)
        valueless = runs - sum(int(np.isfinite(group.values).all(axis=1).sum()) for group in groups)
        rows.append([estimator, str(runs), str(stopped), str(failed), str(valueless)])
    return [markdown_table(["estimator", "estimates", "not converged", "failed", "without a value"], rows, "lrrrr")]


def error_table(found: Found) -> str:
    """N times the mean-square error at a few numbers of samples."""
    rows = []
    names = list(dict.fromkeys(row.parameter for row in found.errors))
    cells = {(row.estimator, row.samples, row.parameter): row for row in found.errors}
    sizes = some([row.samples for row in found.errors])
    for estimator in by_estimator(found):
        for size in sizes:
            line = [cells.get((estimator, size, name)) for name in names]
            if any(line):
                rows.append([estimator, str(size), *map(with_ratio, line)])
        known = {row.parameter: row.theory for row in found.errors if row.estimator == estimator}
        theory = [known.get(name) for name in names]
        rows.append([estimator, "theory", *(number(value, 4) for value in theory)])
    return markdown_table(["estimator", "N", *names], rows, "lr" + "r" * len(names))


def with_ratio(row: ParameterErrors | None) -> str:
    """One cell of the table of errors."""
    return "-" if row is None or row.n_mse is None else f"{number(row.n_mse, 3)} ({number(row.ratio, 3)})"


def ratio_tables(found: Found) -> list[str]:
    """Paired ratios at a few numbers of samples, one table for each other estimator."""
    cells: dict[str, dict[int, dict[str, dict[str, Any]]]] = {}
    for row in ratios(found):
        cells.setdefault(row["estimator"], {}).setdefault(row["samples"], {})[row["parameter"]] = row
    written = []
    for estimator, lines in cells.items():
        names = list(next(iter(lines.values())))
        rows = [
            [str(size), *(f"{row['ratio']:.2f} ± {row['standard_error']:.2f}" for row in lines[size].values())]
            for size in some([*lines])
        ]
        rows.append(["theory", *(f"{row['theory']:.3f}" for row in next(iter(lines.values())).values())])
        written.append(markdown_table([f"{estimator}: N", *names], rows, "r" * (len(names) + 1)))
    return written


def bias_table(found: Found) -> str:
    """Biases, a line for each estimator."""
    names = list(dict.fromkeys(row.parameter for row in found.errors))
    rows = []
    for estimator in by_estimator(found):
        own = [row for row in found.errors if row.estimator == estimator]
        cells = [f"{row.bias_per_deviation or 0.0:+.2f} ({row.bias_per_error or 0.0:+.1f})" for row in own]
        rows.append([estimator, *cells])
    return markdown_table(["estimator", *names], rows, "l" + "r" * len(names))


def beam_table(found: Found) -> str:
    """Mean and scatter of every parameter of the beam."""
    rows = [
        [row.parameter, number(row.true, 4), number(row.true + row.bias, 4), number(row.deviation, 2), str(row.counted)]
        for row in found.errors
        if row.bias is not None
    ]
    return markdown_table(["parameter", "true", "mean estimate", "standard deviation", "n"], rows, "lrrrr")


def coverage_table(experiments: Sequence[Found]) -> str:
    """Coverage with its interval, a line for each parameter."""
    rows = []
    for found in experiments:
        for row in found.errors:
            formula = row.estimator + (" (misused)" if is_misused(found, row.estimator) else "")
            interval = "-" if row.low is None or row.high is None else f"{row.low:.1f} to {row.high:.1f}"
            cells = [found.name, formula, row.parameter, number(row.coverage, 3), interval]
            rows.append([*cells, number(row.error_ratio, 3), str(row.counted)])
    header = ["experiment", "formula", "parameter", "covered", "95 % interval", "standard error / scatter", "n"]
    return markdown_table(header, rows, "lllrrrr")


if __name__ == "__main__":
    main()
