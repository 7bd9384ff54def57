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
    for line in coverage(results).to_dict("records"):
        if not line["misused"]:
            yield within(f"coverage of {line['parameter']} [%], {line['formula']} formula", line["percent"], *BAND)


def white_formula_is_misused(results: Results) -> Iterator[Claim]:
    """Under coloured noise the formula for white noise covers too seldom."""
    for line in coverage(results).to_dict("records"):
        if line["misused"]:
            yield within(f"coverage of {line['parameter']} [%], white formula misused", line["percent"], high=MISUSED)


def held_samples_shorten_the_delay(results: Results) -> Iterator[Claim]:
    """An input known by its samples only is held too long, which no interval covers."""
    for line in coverage(results).to_dict("records"):
        if line["parameter"] == "delay":
            yield within("coverage of the delay [%], input known by its samples", line["percent"], high=BIASED)
