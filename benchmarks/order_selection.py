"""How often is the right number of poles and zeros recommended? Six systems, N = 2000, white noise at 15 dB.

    python benchmarks/order_selection.py FILE [--runs 200] [--seed 20261123] [--publish FOLDER]

Each run draws an input of random levels and noise, and searches 1 to 6 poles with 0 to 3 zeros and a free delay. A line
for each run goes to FILE, a CSV file; what is there already is not computed again. Ends with a
table, which is written with the runs and their environment if a folder is given.
"""

import argparse
import csv
import json
import platform
import time
from pathlib import Path

import numpy as np

from ctid_cli import HeldSignal, Record, TransferFunction, simulate
from ctid_cli.estimators.order_search import recommend_order
from ctid_cli.storage.identity import git_commit, now, numeric_platform, package_versions

#: System, sampling interval and least duration of a level [s], bounds of the delay [s], poles and zeros, or None.
CASES = {
    "case 1": (TransferFunction([2], [0.25, 0.7, 1], 8), 0.05, 0.05, (0, 15), "2/0"),
    "case 2": (TransferFunction([-6400, 1600], [1, 5, 408, 416, 1600], 8), 0.01, 0.01, (0, 15), "4/1"),
    "double pole": (TransferFunction([1], [1, 2, 1]), 0.1, 0.5, (0, 2), "2/0"),
    "first order": (TransferFunction([1], [1, 1], 0.73), 0.05, 0.25, (0, 2), "1/0"),
    "two modes": (TransferFunction([6, 1.6, 14], [1, 0.8, 10.12, 2.4, 9]), 0.1, 0.5, (0, 2), "4/2"),
    "noise": (None, 0.1, 0.5, (0, 2), "none"),
}
SAMPLES, SNR_DB = 2000, 15.0
COLUMNS = ("case", "run", "seed", "right", "recommended", "cpu_seconds")


def record_of(case: str, run: int, seed: int) -> Record:
    """The data set of a run."""
    model, interval, hold, _, _ = CASES[case]
    rng = np.random.default_rng([seed, list(CASES).index(case), run])
    t = interval * np.arange(SAMPLES)
    width = round(hold / interval)
    levels = np.repeat(rng.choice([-1.0, 1.0], -(-SAMPLES // width)), width)[:SAMPLES]
    signal = HeldSignal(t, levels, "zoh")
    noise = rng.standard_normal(SAMPLES)
    if model is None:
        return Record(t, noise, signal)
    x = simulate(model, signal, t)
    return Record(t, x + np.sqrt(np.mean(x**2) / 10 ** (SNR_DB / 10)) * noise, signal)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--seed", type=int, default=20261123)
    parser.add_argument("--publish", type=Path)
    given = parser.parse_args()
    rows = list(csv.DictReader(given.file.open())) if given.file.exists() else []
    done = {(row["case"], int(row["run"])) for row in rows if int(row["seed"]) == given.seed}
    with given.file.open("a", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        if not rows:
            writer.writeheader()
        for run in range(given.runs):
            for case, (_, _, _, bounds, right) in CASES.items():
                # Of noise half as many.
                if (case, run) in done or (case == "noise" and run >= given.runs // 2):
                    continue
                started = time.process_time()
                found = recommend_order(record_of(case, run, given.seed), (1, 6), (0, 3), bounds).recommended
                name = "none" if found is None else found.name
                row = dict(zip(COLUMNS, (case, run, given.seed, right, name, None), strict=True))
                row["cpu_seconds"] = f"{time.process_time() - started:.3f}"
                writer.writerow(row)
                file.flush()
                rows.append(row)
    print(table(rows))
    if given.publish:
        publish(rows, given.publish)


def table(rows: list[dict[str, str]]) -> str:
    """How often each case was right, and what was recommended otherwise."""
    lines = ["| case | right | runs | recommended | otherwise |", "|:--|:--|--:|--:|:--|"]
    for case, (*_, right) in CASES.items():
        own = [row["recommended"] for row in rows if row["case"] == case]
        hits = own.count(right)
        others = ", ".join(f"{own.count(name)} x {name}" for name in sorted(set(own) - {right}))
        lines.append(f"| {case} | {right} | {len(own)} | {hits} ({100 * hits / max(len(own), 1):.1f} %) | {others} |")
    return "\n".join(lines)


def publish(rows: list[dict[str, str]], folder: Path) -> None:
    """Write the runs, their table, and what made them."""
    folder.mkdir(parents=True, exist_ok=True)
    commit = git_commit(Path(__file__).resolve().parents[1])
    packages = {"python": platform.python_version(), **package_versions()}
    environment = {"commit": commit, "published": now(), "numeric_platform": numeric_platform(), "packages": packages}
    (folder / "environment.json").write_text(json.dumps(environment, indent=2) + "\n", encoding="utf-8")
    with (folder / "orders.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    seeds = ", ".join(sorted({row["seed"] for row in rows}))
    text = (
        "# How often the right order is recommended\n\n"
        f"{SAMPLES} samples, input of random levels, white noise at {SNR_DB:g} dB; searched were 1 to 6 poles\n"
        f"with 0 to 3 zeros and a free delay. Seed {seeds}, which nothing was tuned on. Made by\n"
        f"`benchmarks/order_selection.py` at commit {commit}.\nOf noise the right answer is that there is no model.\n\n"
    )
    (folder / "orders.md").write_text(text + table(rows) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
