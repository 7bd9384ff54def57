"""Deviations of results from theory in sentences, each with its reason if the specification gives one.

The bias, the standard errors, the coverage of intervals and the root mean square error of every parameter in every cell
are tested. Holm's correction over all tests of a table limits the probability of any sentence about an experiment that
agrees with theory to ``LEVEL``.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ctid_cli.inference.monte_carlo import Measured
from ctid_cli.inference.monte_carlo_tests import MEASURED, Departure, departures
from ctid_cli.inference.paired import holm
from ctid_cli.progress import reported
from ctid_cli.reporting.layout import delay_label, setting_text, setting_title
from ctid_cli.reporting.measures import Row, counted_in, label_frame, measure_frame, parts_of, records_of, settings_of
from ctid_cli.reporting.results import Results, lookup
from ctid_cli.simulation.dataset import SimulatedSource
from ctid_cli.simulation.expected_accuracy import why_biased
from ctid_cli.specification.joint_checks import joint_warnings

#: Probability of a sentence about an experiment that agrees with theory.
LEVEL = 0.05
#: An RMSE of the delay this far above theory indicates a search that ends in several minima.
FAR = 2.0
#: Each kind of deviation in words, from its size.
PHRASES = {
    "bias": "biased by {:.2g} standard errors",
    "small": "standard errors {:.2g} times too small",
    "large": "standard errors {:.2g} times too large",
    "coverage": "95 % intervals that miss the truth in {:.3g} %",
    "rmse": "RMSE {:.2g} times theory",
}


class Finding(NamedTuple):
    """One test of one parameter."""

    group: int
    #: Keys of the rows of its group.
    labels: Row
    parameter: str
    test: Departure

    @property
    def estimator(self) -> str:
        """Name of the estimator."""
        return str(self.labels["method"])


@reported("comparing results with theory")
def surprises(results: Results) -> list[str]:
    """Return the deviations of estimates of simulated systems from theory, one sentence for each reason."""
    if not results.is_simulated:
        return []
    tested = list(_tested(results))
    adjusted = holm([finding.test.p_value for finding in tested])
    found = [finding for finding, p_value in zip(tested, adjusted, strict=True) if p_value < LEVEL]
    far = {f.estimator for f in tested if (f.parameter, f.test.kind) == ("delay", "rmse") and f.test.size >= FAR}
    together: dict[tuple[str, tuple[str, ...]], list[Finding]] = {}
    for finding in found:
        reasons = tuple(_reasons(results, finding, far))
        together.setdefault((finding.estimator, reasons), []).append(finding)
    return [describe(name, reasons, members, tested) for (name, reasons), members in together.items()]


def _tested(results: Results) -> Iterator[Finding]:
    labels = dict(enumerate(records_of(label_frame(results))))
    frame = measure_frame(results, MEASURED).dropna(subset="parameter")
    frame["counted"] = counted_in(frame)
    for (group, parameter), own in parts_of(frame, frame.index, "parameter"):
        rows = own.set_index("measure")
        found = {str(row["measure"]): Measured(row["value"], row["error"]) for row in records_of(own)}
        for test in departures(found, *rows.loc[["bias", "error_ratio"], "counted"]):
            yield Finding(group, labels[group], parameter, test)


def _reasons(results: Results, finding: Finding, far: set[str]) -> list[str]:
    """Return the reasons for a finding in the specification, the most important first."""
    kind, plan, (k, j, start) = finding.test.kind, results.plan, results.place(finding.group)
    source = None if plan is None else plan.data_cells[k].source
    if plan is None or not isinstance(source, SimulatedSource):
        return []
    cell, part = results.manifest["data_cells"][k]["content"], results.manifest["estimators"][j]
    warned = any(path[:2] == ("sampling", "input_record") for path, _ in joint_warnings(plan.spec))
    rows = results.members(finding.group)
    white = rows.has("covariance") and float(np.mean(rows.column("covariance") == b"white")) > 0.5
    coloured = source.noise is not None and getattr(source.noise, "coloured", True)
    treated = next((key for key in ("initial_state", "offset") if part["content"].get(key) == "estimate"), "")
    clauses: Mapping[str, Any] = {
        why_biased(source, plan.estimators[j].estimator): True,
        "the input is known only at its samples (sampling.input_record: sampled)": (
            warned and lookup(cell, "sampling.input_record") == "sampled"
        ),
        f"the noise is coloured (noise.kind: {lookup(cell, 'noise.kind')}), and these standard errors are for white "
        "noise": kind in ("small", "large", "coverage") and white and coloured,
        "the search for the delay can end at another minimum of the cost (starts.initial_delay)": (
            finding.estimator in far and start != "none"
        ),
        f"theory does not count what else is estimated (estimators.{part['name']}.{treated}: estimate)": (
            kind == "rmse" and treated
        ),
    }
    return [clause for clause, holds in clauses.items() if clause and holds]


def describe(name: str, reasons: Sequence[str], found: Sequence[Finding], tested: Sequence[Finding]) -> str:
    """Return the findings on an estimator for one reason: the worst case of each kind, and the number of cells."""
    phrases = []
    for kind, phrase in PHRASES.items():
        if members := [finding for finding in found if finding.test.kind == kind]:
            worst = max(members, key=lambda finding: finding.test.size)
            place = ", ".join([worst.parameter, *_swept(worst.labels, tested)])
            phrases.append(f"{phrase.format(worst.test.size)} ({place})")
    own = {finding.group for finding in tested if finding.estimator == name}
    where = f", in {len({finding.group for finding in found})} of {len(own)} cells, at worst" if len(own) > 1 else ""
    return f"{name}{where}: {', '.join(phrases)}{': ' * bool(reasons)}{'; '.join(reasons)}"


def _swept(labels: Row, tested: Sequence[Finding]) -> Iterator[str]:
    """Yield the settings that differ between cells, with their values in one of them."""
    for key in (*settings_of(labels), "initial_delay"):
        if len({str(finding.labels[key]) for finding in tested}) > 1:
            title = "initial delay" if key == "initial_delay" else setting_title(key)
            value = labels[key]
            yield f"{title} {delay_label(value) if key == 'initial_delay' else setting_text(key, value)}"
