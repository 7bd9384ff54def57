"""Claims of a study: what must hold of its results, with the number that decides."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from ctid_cli.reporting.layout import Table

COLUMNS = ("experiment", "claim", "measured", "required", "holds")


@dataclass(frozen=True)
class Claim:
    """One thing that must hold; ``holds`` is None for what is only reported."""

    claim: str
    measured: str
    required: str = ""
    holds: bool | None = None
    #: Experiments whose results decide, filled in where claims are collected.
    experiment: str = ""

    @property
    def cells(self) -> list[str]:
        """The claim as a line of a table."""
        verdict = {True: "yes", False: "NO", None: ""}[self.holds]
        return [self.experiment, self.claim, self.measured, self.required, verdict]


def within(claim: str, value: float | None, low: float = -math.inf, high: float = math.inf, shown: str = "") -> Claim:
    """The claim that a number lies in an interval; None stands for what never came."""
    number = math.inf if value is None else float(value)
    if math.isinf(low):
        required = f"at most {high:g}"
    else:
        required = f"at least {low:g}" if math.isinf(high) else f"{low:.5g} to {high:.5g}"
    return Claim(claim, shown or f"{number:.4g}", required, low <= number <= high)


def near(claim: str, value: float | None, target: float, tolerance: float) -> Claim:
    """The claim that a number lies around another one."""
    return within(claim, value, target - tolerance, target + tolerance)


def claims_table(claims: Sequence[Claim], style: str = "text") -> str:
    """Claims as a table, ``text`` or ``md``, and how many hold."""
    table = Table(COLUMNS, [claim.cells for claim in claims], "lllll").draw(style)
    judged = [claim.holds for claim in claims if claim.holds is not None]
    return f"{table}\n\n{sum(judged)} of {len(judged)} hold\n"
