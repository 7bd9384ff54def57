"""What results show that theory does not expect, in sentences, each with its reason where the specification holds one.

Of every parameter in every cell are tested its bias, its standard errors, the coverage of its intervals and its root
mean square error beside that of theory. Finite records are not ideal: small departures are allowed for, and a test asks
whether one is larger than that. Holm's correction over all tests of a table keeps the chance that an experiment as
theory expects it is said anything of below ``LEVEL``.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from statistics import NormalDist
from typing import Any, NamedTuple

import numpy as np

from ctid_cli.inference.monte_carlo import QUANTILE
from ctid_cli.inference.paired import holm
from ctid_cli.reporting.expected_accuracy import why_biased
from ctid_cli.reporting.layout import delay_label, setting_text, setting_title
from ctid_cli.reporting.measures import Row, counted_in, labelled_groups, measure_rows, settings_of
from ctid_cli.reporting.parameter_errors import place_of, readable_plan
from ctid_cli.reporting.results import Group, Results, lookup
from ctid_cli.simulation.dataset import SimulatedSource
from ctid_cli.specification.joint_warnings import joint_warnings
from ctid_cli.storage.manifest import is_of_signal, true_values

#: Chance of a sentence about an experiment that is as theory expects it.
LEVEL = 0.05
#: Fewer data sets than these say nothing.
FEWEST = 50
#: What is allowed for: a bias in standard deviations of one estimate, standard errors that are too small or too large
#: by a factor, and an RMSE above theory by one.
BIAS, SMALL, LARGE, EXCESS = 0.25, 1.1, 1.25, 1.25
#: Coverage of intervals that are shorter by that factor.
COVERAGE = 2.0 * NormalDist().cdf(QUANTILE / SMALL) - 1.0
#: An RMSE of the delay so far above theory is that of a search which ends in several minima.
FAR = 2.0
#: What is measured for it.
MEASURED = ("bias", "deviation", "standard_error", "error_ratio", "coverage", "efficiency")


class Finding(NamedTuple):
    """One test of one parameter."""

    group: Group
    labels: Row
    parameter: str
    kind: str
    #: Bias in standard errors, ratio of standard errors, coverage [%], or RMSE over that of theory.
    size: float
    p_value: float


def surprises(results: Results) -> list[str]:
    """What the estimates of simulated systems show that theory does not expect, one sentence for each reason."""
    if is_of_signal(results.manifest) or not any(map(true_values, results.manifest["data_cells"])):
        return []
    tested = list(_tested(results, measure_rows(results, MEASURED)))
    adjusted = holm([finding.p_value for finding in tested])
    found = [finding for finding, p_value in zip(tested, adjusted, strict=True) if p_value < LEVEL]
    if not found:
        return []
    reasons, together = _Reasons(results, tested), dict[tuple[str, tuple[str, ...]], list[Finding]]()
    for finding in found:
        together.setdefault((finding.group.estimator, tuple(reasons.of(finding))), []).append(finding)
    cells = {finding.group for finding in tested}
    swept = [key for key in (*settings_of(f.labels for f in tested), "initial_delay") if _differs(tested, key)]
    return [_sentence(name, why, members, cells, swept) for (name, why), members in together.items()]


# --- tests ----------------------------------------------------------------------------------------------------------


def _tested(results: Results, rows: Iterable[Row]) -> Iterator[Finding]:
    by_cell: dict[tuple[Any, ...], dict[str, dict[str, Row]]] = {}
    labelled = list(labelled_groups(results))
    for row in rows:
        place = tuple(row[key] for key in labelled[0][1])
        by_cell.setdefault(place, {}).setdefault(row["parameter"], {})[row["measure"]] = row
    for group, labels in labelled:
        for parameter, measured in by_cell[*labels.values()].items():
            for kind, size, p_value in _tests(measured):
                yield Finding(group, labels, parameter, kind, size, p_value)


def _tests(measured: Mapping[str, Row]) -> Iterator[tuple[str, float, float]]:
    """Kind, size and p-value of what can be tested of a parameter."""
    some = measured["bias"]
    n = counted_in(some)
    if n < FEWEST or not some["error"]:
        return
    value = {name: row["value"] for name, row in measured.items()}
    scale = value["standard_error"] or value["deviation"]
    yield "bias", value["bias"] / scale, _p_value(value["bias"], BIAS * value["deviation"], some["error"], n)
    known = counted_in(measured["error_ratio"])
    if (ratio := value["error_ratio"]) and known >= FEWEST:
        # Where errors with heavy tails happened to be small, the jackknife believes too much in their deviation.
        error = max(measured["error_ratio"]["error"] / ratio, 1.0 / math.sqrt(2.0 * known))
        margin = math.log(SMALL if ratio < 1.0 else LARGE)
        yield "width", ratio, _p_value(math.log(ratio), margin, error, known)
    if value["coverage"] is not None:
        from scipy.special import bdtr

        yield "coverage", value["coverage"], float(bdtr(round(0.01 * value["coverage"] * n), n, COVERAGE))
    if share := value["efficiency"]:
        error = 0.5 * measured["efficiency"]["error"] / share
        excess = math.log(10.0 / math.sqrt(share))
        yield "rmse", math.exp(excess), _tail((excess - math.log(EXCESS)) / error, n)


def _p_value(value: float, margin: float, error: float, n: int) -> float:
    """Chance of a value as far from zero as this if the true one is at most the margin away."""
    return _tail((abs(value) - margin) / error, n) + _tail((abs(value) + margin) / error, n)


def _tail(x: float, n: int) -> float:
    from scipy.special import stdtr

    return float(stdtr(n - 1, -x))


# --- reasons --------------------------------------------------------------------------------------------------------


class _Reasons:
    """What the specification holds that explains a finding."""

    def __init__(self, results: Results, tested: Iterable[Finding]) -> None:
        self.results = results
        self.plan = readable_plan(results)
        self.far = {f.group.estimator for f in tested if (f.parameter, f.kind) == ("delay", "rmse") and f.size >= FAR}
        warned = [] if self.plan is None else joint_warnings(self.plan.spec)
        self.input_is_late = any(path[:2] == ("sampling", "input_record") for path, _ in warned)

    def of(self, finding: Finding) -> list[str]:
        """Clauses, what matters most first."""
        k, j = place_of(self.results, finding.group)
        cell, part = self.results.manifest["data_cells"][k]["content"], self.results.manifest["estimators"][j]
        source = None if self.plan is None else self.plan.data_cells[k].source
        if self.plan is None or not isinstance(source, SimulatedSource):
            return []
        late = self.input_is_late and lookup(cell, "sampling.input_record") == "sampled"
        rows = self.results.groups()[finding.group]
        white = rows.has("covariance") and float(np.mean(rows.column("covariance") == b"white")) > 0.5
        coloured = source.noise is not None and getattr(source.noise, "coloured", True)
        treated = next((key for key in ("initial_state", "offset") if part["content"].get(key) == "estimate"), "")
        noise, option = lookup(cell, "noise.kind"), f"estimators.{part['name']}.{treated}: estimate"
        clauses = {
            why_biased(source, self.plan.estimators[j].estimator): True,
            "the input is known only at its samples (sampling.input_record: sampled)": late,
            f"the noise is coloured (noise.kind: {noise}), and these standard errors are for white noise": (
                finding.kind in ("width", "coverage") and white and coloured
            ),
            "the search for the delay can end at another minimum of the cost (starts.initial_delay)": (
                finding.group.estimator in self.far and finding.group.start != "none"
            ),
            f"theory does not count what else is estimated ({option})": finding.kind == "rmse" and treated,
        }
        return [clause for clause, holds in clauses.items() if clause and holds]


# --- words ----------------------------------------------------------------------------------------------------------


def _differs(tested: Iterable[Finding], key: str) -> bool:
    return len({str(finding.labels[key]) for finding in tested}) > 1


def _sentence(name: str, why: Sequence[str], found: Sequence[Finding], cells: set[Group], swept: Sequence[str]) -> str:
    """What was found of an estimator for one reason, the worst case of each kind."""
    phrases = []
    for kind in ("bias", "width", "coverage", "rmse"):
        for members in _sides([finding for finding in found if finding.kind == kind]):
            worst = max(members, key=_badness)
            place = [worst.parameter, *(_place(key, worst.labels[key]) for key in swept)]
            phrases.append(f"{_phrase(worst, 'up to ' * (len(members) > 1))} ({', '.join(place)})")
    own = {group for group in cells if group.estimator == name}
    where = f", in {len({finding.group for finding in found})} of {len(own)} cells" if len(own) > 1 else ""
    reason = f": {'; '.join(why)}" if why else ""
    return f"{name}{where}: {', '.join(phrases)}{reason}"


def _sides(found: Sequence[Finding]) -> Iterator[list[Finding]]:
    """Standard errors that are too small are another thing than ones that are too large."""
    for large in (False, True):
        if members := [f for f in found if (f.kind == "width" and f.size > 1.0) == large]:
            yield members


def _badness(finding: Finding) -> float:
    """Return how far the size of a finding lies from what theory expects, on the scale of its kind."""
    if finding.kind == "coverage":
        return -finding.size
    # A ratio of standard errors is as bad as its reciprocal.
    return abs(math.log(finding.size)) if finding.kind == "width" else abs(finding.size)


def _phrase(finding: Finding, up_to: str) -> str:
    size = abs(finding.size)
    if finding.kind == "bias":
        return f"biased by {up_to}{size:.2g} standard errors"
    if finding.kind == "width":
        return f"standard errors {up_to}{max(size, 1 / size):.2g} times too {'large' if size > 1 else 'small'}"
    if finding.kind == "coverage":
        return f"coverage {'down to ' * bool(up_to)}{size:.3g} % of 95 %"
    return f"RMSE {up_to}{size:.2g} times theory"


def _place(key: str, value: Any) -> str:
    title = "initial delay" if key == "initial_delay" else setting_title(key)
    return f"{title} {delay_label(value) if key == 'initial_delay' else setting_text(key, value)}"
