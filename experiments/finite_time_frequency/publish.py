"""Write a finished reproduction to results/published: tables, figures, checks, and the environment that made them.

python -m experiments.finite_time_frequency.publish --results results
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from ctid_cli.reporting.figures.finite_time_frequency import DERIVED
from ctid_cli.reporting.layout import csv_text, markdown_table, number
from ctid_cli.reporting.publication import copy_figures, environment
from ctid_cli.reporting.results import Results
from experiments.additive.publish import rounded
from experiments.finite_time_frequency import as_printed
from experiments.finite_time_frequency.acceptance import ITEMS, write
from experiments.finite_time_frequency.measured import (
    BANDS,
    FIGURES,
    READINGS,
    Row,
    by_estimator,
    efficiency,
    is_derived,
    read_study,
    recovery,
    residuals,
    run_checks,
    settling,
)

#: Titles of the experiments in the tables.
TITLES = {
    "two-tones": "Section VI-A, sin 2t + cos 3t, no noise",
    "harmonic": "Section VI-B, sin 2t + sin 3t disturbed by 0.25 sin 15t",
    "random": "Section VI-B, sin 2t + sin 3t, noise uniform in ±0.2",
    "step": "Section VI-C, step of both frequencies at 30 s, no noise",
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Parse the command line and write; exit code 1 if a check does not hold."""
    parser = argparse.ArgumentParser(
        description="Publish a finished reproduction of the study of finite-time estimation."
    )
    parser.add_argument("--results", type=Path, default=Path("results"))
    parser.add_argument("--out", type=Path, default=Path("results/published/finite_time_frequency"))
    parser.add_argument("--items", nargs="*", choices=list(ITEMS), default=list(ITEMS), help="checks (default all)")
    chosen = parser.parse_args(arguments)
    study = read_study(chosen.results)
    if not study:
        parser.error(f"there are no results of this study in {chosen.results}; run first: make reproduce-frequency")
    chosen.out.mkdir(parents=True, exist_ok=True)
    checks = [*(check for item in chosen.items for check in ITEMS[item]()), *run_checks(study)]
    files = {name: csv_text([rounded(row) for row in rows]) for name, rows in numbers(study).items() if rows}
    files |= {
        "tables.md": tables(study),
        "acceptance.md": write(checks),
        "environment.json": environment(chosen.results, [f"finite-time-frequency/{name}" for name in study]),
    }
    for name, text in files.items():
        (chosen.out / name).write_text(text, encoding="utf-8")
    copy_figures(chosen.results / "finite_time_frequency_figures", chosen.out / "figures")
    missed = [check for check in checks if not check.met]
    for check in missed:
        sys.stdout.write(f"MISSED {check.item}: {check.name}: {check.value:.4g} ({check.bounds})\n")
    sys.stdout.write(f"{len(checks) - len(missed)} of {len(checks)} checks hold\n")
    if missed:
        raise SystemExit(1)


def numbers(study: Mapping[str, Results]) -> dict[str, list[Row]]:
    """Everything that was measured, by file."""
    of_paper = [study[name] for name in FIGURES if name in study]
    recovered = [study[name] for name in ("recovery", "recovery-in-noise") if name in study]
    return {
        "settling.csv": [row for results in of_paper for row in settling(results)],
        "residuals.csv": [row for results in of_paper for row in residuals(results)],
        "recovery.csv": [row for results in recovered for row in recovery(results)],
        "efficiency.csv": list(efficiency(study["efficiency"])) if "efficiency" in study else [],
    }


def tables(study: Mapping[str, Results]) -> str:
    """What a reader wants to see, as Markdown."""
    parts = [
        "`observer`, `filter` and `filter_gradient` are derived, not the published algorithms: the equations of the "
        "two comparators of the paper were not to be had. Frequencies and errors in rad/s, times in s."
    ]
    for name, figure in FIGURES.items():
        if name in study:
            parts += [f"### {TITLES[name]} ({figure})", *paper_tables(study[name])]
    parts += recovery_tables(study)
    if "efficiency" in study:
        parts += efficiency_tables(study["efficiency"])
    parts += ["### The formulas as they are printed", as_printed.table()]
    return "\n\n".join(parts) + "\n"


def named(estimator: str) -> str:
    """An estimator as the tables show it."""
    return f"`{estimator}`, {DERIVED}" if is_derived(estimator) else f"`{estimator}`"


def time(value: float | None) -> str:
    """A time [s], or that it never came."""
    return "never" if value is None else f"{value:.2f}"


def paper_tables(results: Results) -> list[str]:
    """Settling times and errors of one experiment of the paper, one table for each reading of the step."""
    settled, left = list(settling(results)), list(residuals(results))
    window = results.settings["tracks"]["window"]
    readings = [reading for reading in READINGS if any(row["reading"] == reading for row in settled)] or [""]
    written = []
    for reading in readings:
        errors = by_estimator([row for row in left if row["reading"] == reading])
        times = by_estimator([row for row in settled if row["reading"] == reading])
        pieces = list(dict.fromkeys(row["piece"] for rows in times.values() for row in rows))
        header = ["estimator"]
        for piece in pieces:
            of_piece = f", {piece}" if len(pieces) > 1 else ""
            header += [f"{'within ' if not k else ''}{band:g}{of_piece}" for k, band in enumerate(BANDS)]
        header += ["rms w1", "rms w2", "valid [%]", "valid, off by 0.05 [s]"]
        rows = []
        for estimator, tones in errors.items():
            found = {row["piece"]: row for row in times.get(estimator, [])}
            cells = [named(estimator)]
            for piece in pieces:
                cells += [time(found[piece][f"within_{band:g}"]) if found else "-" for band in BANDS]
            wrong = number(next(iter(found.values()))["valid_but_off_by_0.05"], 3) if found else "-"
            cells += [number(tone["rms"], 2) for tone in tones]
            rows.append([*cells, number(tones[0]["valid_share"], 3), wrong])
        runs = max(row["data_sets"] for row in left)
        sets = f"medians of {runs} data sets, " if runs > 1 else ""
        after = {"jump": "Phase w(t) t, as printed: it jumps. ", "continuous": "Phase the integral of w(t). "}
        written.append(
            f"{after.get(reading, '')}Time until both errors are below a band to stay"
            f"{', each piece from its beginning' if len(pieces) > 1 else ''}, to 0.01 s; root-mean-square errors "
            f"over {window[0]:g} to {window[1]:g} s ({sets}last columns: share of valid estimates, and how long one "
            "was called valid with an error above 0.05). Whole records: error of the one estimate."
        )
        written.append(markdown_table(header, rows, "l" + "r" * (len(header) - 1)))
    return written


def recovery_tables(study: Mapping[str, Results]) -> list[str]:
    """How soon the frequencies are right again after a step."""
    parts = []
    if "recovery" in study:
        rows = []
        found = by_estimator(list(recovery(study["recovery"])))
        for estimator, readings in found.items():
            by_reading = {row["reading"]: row for row in readings}
            rows.append([named(estimator), *(exact_time(by_reading[name]["median"]) for name in READINGS)])
        header = ["estimator", *(f"{name} [s]" for name in READINGS)]
        parts += [
            "### Beyond the paper: recovery from the step without noise",
            "Time from the step until both errors are below 1e-6, to stay to the end, 60 s after the step.",
            markdown_table(header, rows, "lrr"),
        ]
    if "recovery-in-noise" in study:
        rows = []
        found = by_estimator(list(recovery(study["recovery-in-noise"])))
        for estimator, readings in found.items():
            cells = [named(estimator)]
            for row in sorted(readings, key=lambda row: READINGS.index(row["reading"])):
                never = str(row["never"])
                cells += [time(row["median"]), time(row["longest"]), never, number(row["false_alarms"], 3)]
                cells += [number(row["rms"], 2)]
            rows.append(cells)
        header = ["estimator"]
        for reading in READINGS:
            header += [f"{reading}: median [s]", "longest [s]", "never", "false alarms", "rms error, 80 to 90 s"]
        count = max(row["data_sets"] for readings in found.values() for row in readings)
        parts += [
            "### Beyond the paper: recovery from the step in noise",
            f"White Gaussian noise of standard deviation 0.11547, {count} data sets for each reading. Time from the "
            "step until both errors are below 0.02, to stay to the end, 60 s after the step. False alarms over all "
            "data sets; rms error: median of the worse tone.",
            markdown_table(header, rows, "l" + "r" * (len(header) - 1)),
        ]
    return parts


def exact_time(value: float | None) -> str:
    """A time to a thousandth of a second, or that it never came."""
    return "never" if value is None else f"{value:.3f}"


def efficiency_tables(results: Results) -> list[str]:
    """Errors over the Cramer-Rao bound, and the bias that is a part of them."""
    found = by_estimator(list(efficiency(results)))
    rows = []
    for estimator, tones in found.items():
        cells = [named(estimator)]
        for tone in tones:
            ratio = f"{number(tone['ratio'], 3)} ± {number(tone['ratio_error'], 2)}"
            bias = f"{number(tone['bias'], 2)} ± {number(tone['bias_error'], 1)}"
            cells += [ratio, bias, number(tone["deviation"], 2)]
        rows.append([*cells, number(tones[0]["valid_share"], 3)])
    tones = next(iter(found.values()))
    bounds = " and ".join(number(tone["bound"], 3) for tone in tones)
    header = ["estimator"]
    for k in range(1, len(tones) + 1):
        header += [f"w{k}: rms error / bound", "bias", "standard deviation"]
    return [
        "### Beyond the paper: errors after 20 s of the noise of section VI-B",
        f"{tones[0]['data_sets']} data sets. The Cramer-Rao bound is that of Gaussian noise of the same variance: "
        f"standard deviations of {bounds} rad/s. ± is one standard deviation of the Monte Carlo; valid: mean share of "
        "the 20 s, for whole records share of the data sets.",
        markdown_table([*header, "valid [%]"], rows, "l" + "r" * len(header)),
    ]


if __name__ == "__main__":
    main()
