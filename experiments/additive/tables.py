"""What is published of the study: all errors as numbers, and the tables that a reader wants to see."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from ctid_cli.reporting.layout import markdown_table, number
from ctid_cli.reporting.results import Results
from ctid_cli.studies.catalogue import StudyResults, last_part

from .measures import ParameterErrors, by_estimator, errors_of, is_misused, parameters, ratios

#: Numbers of samples that the text shows, of all that were run.
SIZES = 6
#: Experiments on coverage.
COVERING = ("coverage-open-loop", "coverage-closed-loop")
TITLES = {
    "open-loop": "Open loop, section 6.1 (figure 3)",
    "closed-loop": "Closed loop, section 6.2 (figure 4)",
    "closed-loop-coloured": "Closed loop with coloured noise",
    "flexible-beam": "Flexible beam, SIMULATED stand-in (figure 6)",
}


def errors(results: Results) -> Iterator[dict[str, Any]]:
    """Errors of every parameter."""
    return (vars(row) for row in errors_of(results))


def coverage(results: Results) -> Iterator[dict[str, Any]]:
    """How often 95 % intervals contain the truth."""
    for row in errors_of(results):
        yield vars(row) | {"misused": "yes" if is_misused(results, row.estimator) else "no"}


def unfinished(results: Results) -> Iterator[dict[str, Any]]:
    """Every estimate that failed or did not converge, with what makes it again."""
    samples = {cell["hash"]: cell["content"]["sampling"]["samples"] for cell in results.manifest["data_cells"]}
    for row in results.rows:
        if row["status"] != "CONVERGED":
            yield row | {"samples": samples[row["cell"]], "seed": results.manifest["seed"]}


def tables(found: StudyResults) -> str:
    """The tables for people."""
    parts = []
    for name, title in TITLES.items():
        if name not in found:
            continue
        results = found[name]
        parts += [f"### {title}", convergence_table(results)]
        if name in ("open-loop", "closed-loop"):
            parts += ["N times the mean-square error; in brackets its ratio to theory.", error_table(results)]
            parts += ["Mean-square error over that of the sum of submodels, ± standard error.", *ratio_tables(results)]
        elif name == "closed-loop-coloured":
            parts += [
                "Bias in standard deviations of one estimate; in brackets in standard errors.",
                bias_table(results),
            ]
        else:
            parts += ["Estimates and truth over all data sets.", beam_table(results)]
    covering = [found[name] for name in COVERING if name in found]
    if covering:
        parts += ["### Coverage of 95 % intervals [%]", coverage_table(covering)]
    return "\n\n".join(parts) + "\n"


def some(sizes: Iterable[int]) -> list[int]:
    """A few numbers of samples, the least and the greatest among them."""
    ordered = sorted(set(sizes))
    return [ordered[k] for k in np.unique(np.linspace(0, len(ordered) - 1, SIZES).round().astype(int))]


def convergence_table(results: Results) -> str:
    """Counts of estimates that are not as they should be; all that have a value count in the tables below."""
    rows = []
    for estimator, groups in by_estimator(results).items():
        valueless = sum(int(np.isnan(group.values).any(axis=1).sum()) for group in groups)
        counts = [sum(getattr(group, name) for group in groups) for name in ("runs", "not_converged", "failed")]
        rows.append([estimator, *map(str, [*counts, valueless])])
    return markdown_table(["estimator", "estimates", "not converged", "failed", "without a value"], rows, "lrrrr")


def error_table(results: Results) -> str:
    """N times the mean-square error at a few numbers of samples."""
    rows, names = [], parameters(results)
    cells = {(row.estimator, row.samples, row.parameter): row for row in errors_of(results)}
    for estimator in by_estimator(results):
        for size in some(row.samples for row in errors_of(results)):
            line = [cells.get((estimator, size, name)) for name in names]
            if any(line):
                rows.append([estimator, str(size), *map(with_ratio, line)])
        known = {row.parameter: row.theory for row in errors_of(results) if row.estimator == estimator}
        rows.append([estimator, "theory", *(number(known.get(name), 4) for name in names)])
    return markdown_table(["estimator", "N", *names], rows, "lr" + "r" * len(names))


def with_ratio(row: ParameterErrors | None) -> str:
    """One cell of the table of errors."""
    return "-" if row is None or row.n_mse is None else f"{number(row.n_mse, 3)} ({number(row.ratio, 3)})"


def ratio_tables(results: Results) -> list[str]:
    """Paired ratios at a few numbers of samples, one table for each other estimator."""
    cells: dict[str, dict[int, list[Mapping[str, Any]]]] = {}
    for row in ratios(results):
        cells.setdefault(row["estimator"], {}).setdefault(row["samples"], []).append(row)
    written = []
    for estimator, lines in cells.items():
        first = next(iter(lines.values()))
        rows = [
            [str(size), *(f"{row['ratio']:.2f} ± {row['standard_error']:.2f}" for row in lines[size])]
            for size in some(lines)
        ]
        rows.append(["theory", *(f"{row['theory']:.3f}" for row in first)])
        header = [f"{estimator}: N", *(row["parameter"] for row in first)]
        written.append(markdown_table(header, rows, "r" * len(header)))
    return written


def bias_table(results: Results) -> str:
    """Biases, a line for each estimator."""
    rows = []
    for estimator in by_estimator(results):
        own = [row for row in errors_of(results) if row.estimator == estimator]
        cells = [f"{row.bias_per_deviation or 0.0:+.2f} ({row.bias_per_error or 0.0:+.1f})" for row in own]
        rows.append([estimator, *cells])
    names = parameters(results)
    return markdown_table(["estimator", *names], rows, "l" + "r" * len(names))


def beam_table(results: Results) -> str:
    """Mean and scatter of every parameter of the beam."""
    rows = [
        [row.parameter, number(row.true, 4), number(row.true + row.bias, 4), number(row.deviation, 2), str(row.counted)]
        for row in errors_of(results)
        if row.bias is not None
    ]
    return markdown_table(["parameter", "true", "mean estimate", "standard deviation", "n"], rows, "lrrrr")


def coverage_table(experiments: Sequence[Results]) -> str:
    """Coverage with its interval, a line for each parameter."""
    rows = []
    for results in experiments:
        for row in errors_of(results):
            formula = row.estimator + (" (misused)" if is_misused(results, row.estimator) else "")
            interval = "-" if row.low is None or row.high is None else f"{row.low:.1f} to {row.high:.1f}"
            cells = [last_part(results.experiment), formula, row.parameter, number(row.coverage, 3), interval]
            rows.append([*cells, number(row.error_ratio, 3), str(row.counted)])
    header = ["experiment", "formula", "parameter", "covered", "95 % interval", "standard error / scatter", "n"]
    return markdown_table(header, rows, "lllrrrr")
