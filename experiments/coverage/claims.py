"""Claims on the study's results."""

from collections.abc import Iterator

from ctid_cli.reporting.results import Results
from ctid_cli.studies.claims import Claim, within

from .tables import coverage

#: Accepted coverage [%], and the largest with coloured noise of the formula for white noise.
BAND, MISUSED = (93.0, 97.0), 85.0
#: Largest coverage [%] of a delay whose bias is much larger than its standard error.
BIASED = 5.0


def intervals_cover(results: Results) -> Iterator[Claim]:
    """Test that intervals have their nominal coverage, with the formula for the noise."""
    return _covered(results, "not misused", "coverage of {parameter} [%], {formula} formula", *BAND)


def white_formula_is_misused(results: Results) -> Iterator[Claim]:
    """Test that with coloured noise the formula for white noise has too low a coverage."""
    return _covered(results, "misused", "coverage of {parameter} [%], white formula misused", high=MISUSED)


def held_samples_shorten_the_delay(results: Results) -> Iterator[Claim]:
    """Test that an input known only by its samples is held too long, which biases the delay beyond any interval."""
    claim = "coverage of the delay [%], input known by its samples"
    return _covered(results, "parameter == 'delay'", claim, high=BIASED)


def _covered(results: Results, lines: str, claim: str, *band: float, **bounds: float) -> Iterator[Claim]:
    """Yield a claim about the percentage in each of some lines of the table."""
    for line in coverage(results).query(lines).to_dict("records"):
        yield within(claim.format(**line), line["percent"], *band, **bounds)
