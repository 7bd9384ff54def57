"""Claims of a study: conditions on its results, with the number that decides."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from ctid_cli.progress import each
from ctid_cli.reporting.document import Result, Section, Table
from ctid_cli.reporting.layout import picked
from ctid_cli.reporting.study import last_part
from ctid_cli.studies.catalogue import StudyResults


@dataclass(frozen=True)
class Claim:
    """A condition on results; ``holds`` is None if it is only reported."""

    claim: str
    measured: str
    required: str = ""
    holds: bool | None = None
    #: Experiments whose results decide, set when claims are collected.
    experiment: str = ""

    @property
    def verdict(self) -> str:
        """Last column of a table of claims."""
        return {True: "yes", False: "NO", None: ""}[self.holds]


def within(claim: str, value: float | None, low: float = -math.inf, high: float = math.inf, shown: str = "") -> Claim:
    """Return the claim that a number lies in an interval; None means that it was never reached."""
    number = math.inf if value is None or math.isnan(value) else float(value)
    if math.isinf(low):
        required = f"at most {high:g}"
    else:
        required = f"at least {low:g}" if math.isinf(high) else f"{low:.5g} to {high:.5g}"
    return Claim(claim, shown or f"{number:.4g}", required, low <= number <= high)


def near(claim: str, value: float | None, target: float, tolerance: float) -> Claim:
    """Return the claim that a number is within a tolerance of another."""
    return within(claim, value, target - tolerance, target + tolerance)


@dataclass(frozen=True, eq=False)
class CheckedClaims(Result):
    """The claims of a study, tested on its results."""

    schema = "ctid-claims-1"

    results: StudyResults
    claims: Sequence[Claim]

    @property
    def failed(self) -> list[Claim]:
        """Claims that do not hold."""
        return [claim for claim in self.claims if claim.holds is False]

    @property
    def counted(self) -> str:
        """Number of claims that hold, in words."""
        tested = [claim.holds for claim in self.claims if claim.holds is not None]
        return f"{sum(tested)} of {len(tested)} hold"

    def content(self) -> dict[str, Any]:
        """Return the claims for JSON."""
        return {"study": self.results.study.name, "claims": [asdict(claim) for claim in self.claims]}

    def sections(self) -> list[Section]:
        """Return the claims."""
        columns = ("experiment", "claim", "measured", "required")
        rows = [{**picked(claim, columns), "holds": claim.verdict} for claim in self.claims]
        return [Section(self.results.study.name, table=Table.of_rows(rows), notes=[self.counted])]


def check_claims(found: StudyResults) -> CheckedClaims:
    """Test all claims of a study on its results; an experiment that was not run is a failed claim."""
    study = found.study
    missing = [short for short in map(last_part, study.configs) if short not in found]
    claims = [Claim("was run", "no", "yes", False, short) for short in missing]
    for function, calls in each("group of claims", study.claims.items()):
        state = getattr(study.module("claims"), function)
        for shorts in calls:
            if set(shorts) <= found.experiments.keys():
                made = state(*(found[short] for short in shorts))
                claims += (replace(claim, experiment=" and ".join(shorts)) for claim in made)
    return CheckedClaims(found, claims)
