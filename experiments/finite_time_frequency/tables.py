"""What is published of the study: everything that was measured as numbers, and the tables for a reader."""

from typing import Any

from ctid_cli.reporting.layout import markdown_table, number
from ctid_cli.reporting.results import Results
from ctid_cli.studies.catalogue import StudyResults

from . import as_printed
from .figures import DERIVED
from .measures import BANDS, READINGS, by_estimator, efficiency, is_derived, recovery, residuals, settling

#: Titles of the experiments of the paper.
TITLES = {
    "two-tones": "Section VI-A, sin 2t + cos 3t, no noise (figure 1)",
    "harmonic": "Section VI-B, sin 2t + sin 3t disturbed by 0.25 sin 15t (figure 2)",
    "random": "Section VI-B, sin 2t + sin 3t, noise uniform in ±0.2 (figure 3)",
    "step": "Section VI-C, step of both frequencies at 30 s, no noise (figure 4)",
}


def tables(found: StudyResults) -> str:
    """The tables for people."""
    parts = [
        "`observer`, `filter` and `filter_gradient` are derived, not the published algorithms: the equations of the "
        "two comparators of the paper were not to be had. Frequencies and errors in rad/s, times in s."
    ]
    for name, title in TITLES.items():
        if name in found:
            parts += [f"### {title}", *paper_tables(found[name])]
    beyond = {"recovery": recovery_table, "recovery-in-noise": noisy_recovery_table, "efficiency": efficiency_table}
    for name, write in beyond.items():
        parts += write(found[name]) if name in found else []
    parts += ["### The formulas as they are printed", as_printed.table()]
    return "\n\n".join(parts) + "\n"


def table(header: list[str], rows: list[list[str]]) -> str:
    """A table whose first column holds names."""
    return markdown_table(header, rows, "l".ljust(len(header), "r"))


def named(estimator: str) -> str:
    """An estimator as the tables show it."""
    return f"`{estimator}`, {DERIVED}" if is_derived(estimator) else f"`{estimator}`"


def time(value: float | None, digits: int = 2) -> str:
    """A time [s], or that it never came."""
    return "never" if value is None else f"{value:.{digits}f}"


def paper_tables(results: Results) -> list[str]:
    """Settling times and errors of one experiment of the paper, one table for each reading of the step."""
    settled, left = list(settling(results)), list(residuals(results))
    pieces = list(dict.fromkeys(row["piece"] for row in settled))
    several = len(pieces) > 1
    header = ["estimator"]
    for piece in pieces:
        of_piece = f", {piece}" if several else ""
        header += [f"{'within ' if not k else ''}{band:g}{of_piece}" for k, band in enumerate(BANDS)]
    header += ["rms w1", "rms w2", "valid [%]", "valid, off by 0.05 [s]"]
    window, runs = results.settings["success"]["window"], max(row["data_sets"] for row in left)
    explained = (
        f"Time until both errors are below a band to stay{', each piece from its beginning' if several else ''}, to "
        f"0.01 s; root-mean-square errors over {window[0]:g} to {window[1]:g} s "
        f"({f'medians of {runs} data sets, ' if runs > 1 else ''}last columns: share of valid estimates, and how long "
        "one was called valid with an error above 0.05). Whole records: error of the one estimate."
    )
    after = {"jump": "Phase w(t) t, as printed: it jumps. ", "continuous": "Phase the integral of w(t). "}
    written = []
    for reading in dict.fromkeys(row["reading"] for row in left):
        times = by_estimator(settled, reading=reading)
        rows = []
        for estimator, tones in by_estimator(left, reading=reading).items():
            cells, wrong = settling_cells({row["piece"]: row for row in times.get(estimator, [])}, pieces)
            cells += [number(tone["rms"], 2) for tone in tones]
            rows.append([named(estimator), *cells, number(tones[0]["valid_share"], 3), wrong])
        written += [after.get(reading, "") + explained, table(header, rows)]
    return written


def settling_cells(found: dict[str, Any], pieces: list[str]) -> tuple[list[str], str]:
    """When an estimator has settled in each piece and band, and how long it was wrong and called valid."""
    if not found:
        return ["-"] * (len(pieces) * len(BANDS)), "-"
    cells = [time(found[piece][f"within_{band:g}"]) for piece in pieces for band in BANDS]
    return cells, number(found[pieces[0]]["valid_but_off_by_0.05"], 3)


def recovery_table(results: Results) -> list[str]:
    """How soon the frequencies are right again after a step without noise."""
    rows = []
    for estimator, readings in by_estimator(list(recovery(results))).items():
        medians = {row["reading"]: row["median"] for row in readings}
        rows.append([named(estimator), *(time(medians[reading], 3) for reading in READINGS)])
    return [
        "### Beyond the paper: recovery from the step without noise",
        "Time from the step until both errors are below 1e-6, to stay to the end, 60 s after the step.",
        table(["estimator", *(f"{name} [s]" for name in READINGS)], rows),
    ]


def noisy_recovery_table(results: Results) -> list[str]:
    """How soon the frequencies are right again after a step in noise."""
    rows, header = [], ["estimator"]
    measured = list(recovery(results))
    for reading in READINGS:
        header += [f"{reading}: median [s]", "longest [s]", "never", "false alarms", "rms error, 80 to 90 s"]
    for estimator, readings in by_estimator(measured).items():
        cells = [named(estimator)]
        for row in sorted(readings, key=lambda row: READINGS.index(row["reading"])):
            cells += [time(row["median"]), time(row["longest"]), str(row["never"])]
            cells += [number(row["false_alarms"], 3), number(row["rms"], 2)]
        rows.append(cells)
    return [
        "### Beyond the paper: recovery from the step in noise",
        f"White Gaussian noise of standard deviation 0.11547, {max(row['data_sets'] for row in measured)} data sets "
        "for each reading. Time from the step until both errors are below 0.02, to stay to the end, 60 s after the "
        "step. False alarms over all data sets; rms error: median of the worse tone.",
        table(header, rows),
    ]


def efficiency_table(results: Results) -> list[str]:
    """Errors over the Cramer-Rao bound, and the bias that is a part of them."""
    found = by_estimator(list(efficiency(results)))
    rows, tones = [], next(iter(found.values()))
    for estimator, own in found.items():
        cells = [named(estimator)]
        for tone in own:
            cells.append(f"{number(tone['ratio'], 3)} ± {number(tone['ratio_error'], 2)}")
            cells.append(f"{number(tone['bias'], 2)} ± {number(tone['bias_error'], 1)}")
            cells.append(number(tone["deviation"], 2))
        rows.append([*cells, number(own[0]["valid_share"], 3)])
    header: list[Any] = ["estimator"]
    for tone in tones:
        header += [f"w{tone['tone']}: rms error / bound", "bias", "standard deviation"]
    return [
        "### Beyond the paper: errors after 20 s of the noise of section VI-B",
        f"{tones[0]['data_sets']} data sets. The Cramer-Rao bound is that of Gaussian noise of the same variance: "
        f"standard deviations of {' and '.join(number(tone['bound'], 3) for tone in tones)} rad/s. ± is one standard "
        "deviation of the Monte Carlo; valid: mean share of the 20 s, for whole records share of the data sets.",
        table([*header, "valid [%]"], rows),
    ]
