"""What must hold of the study's results."""

from collections.abc import Iterator

from ctid_cli.reporting.results import Results
from ctid_cli.studies.claims import Claim, within

from .tables import coverage

#: Coverage [%] that counts as right, and the largest under coloured noise of the formula for white noise.
BAND, MISUSED = (93.0, 97.0), 85.0
#: The largest coverage [%] of a delay that is biased by much more than its standard error.
BIASED = 5.0


def intervals_cover(results: Results) -> Iterator[Claim]:
    """Intervals contain the truth as often as they say, by the formula that is meant for the noise."""
    return _covered(results, "not misused", "coverage of {parameter} [%], {formula} formula", *BAND)


def white_formula_is_misused(results: Results) -> Iterator[Claim]:
    """Under coloured noise the formula for white noise covers too seldom."""
    return _covered(results, "misused", "coverage of {parameter} [%], white formula misused", high=MISUSED)


def held_samples_shorten_the_delay(results: Results) -> Iterator[Claim]:
    """An input known by its samples only is held too long, which no interval covers."""
    claim = "coverage of the delay [%], input known by its samples"
    return _covered(results, "parameter == 'delay'", claim, high=BIASED)


def _covered(results: Results, lines: str, claim: str, *band: float, **bounds: float) -> Iterator[Claim]:
    """Yield a claim about the percentage in each of some lines of the table."""
    for line in coverage(results).query(lines).to_dict("records"):
        yield within(claim.format(**line), line["percent"], *band, **bounds)
