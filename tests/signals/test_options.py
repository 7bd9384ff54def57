"""Options of signals, noises and samplings: refusals in one sentence that names the option."""

from dataclasses import fields
from typing import Annotated, Literal, get_args, get_origin, get_type_hints

import pytest

from ctid_cli.kinds import classes
from ctid_cli.signals.excitation import InputFile, Prbs, Step, Steps
from ctid_cli.signals.multisine import Multisine
from ctid_cli.signals.noise import ArmaNoise, WhiteNoise
from ctid_cli.signals.sampling import JitteredSampling, UniformIntervals
from ctid_cli.signals.sinusoids import Piece, SumOfSinusoids, Tone
from ctid_cli.specification.sections import geometric_sizes

BAND = {"lowest_frequency": 1.0, "highest_frequency": 2.0}
NAN = float("nan")
UNIT = {"numerator": (1.0,), "denominator": (1.0,), "variance": 1.0}


def has_check(hint):
    """Return whether an annotation defines the allowed values, or need not: for names of files and columns."""
    parts = [part for part in get_args(hint) if part not in (type(None), Ellipsis)]
    return get_origin(hint) in (Annotated, Literal) or hint in (str, bool) or bool(parts and all(map(has_check, parts)))


def test_every_option_has_a_check():
    of = {one for section in ("excitation", "sampling", "noise", "disturbance") for one in classes(section).values()}
    assert len(of) == 15
    without = set()
    for one in of:
        hints = get_type_hints(one, include_extras=True)
        without |= {f"{one.__name__}.{option.name}" for option in fields(one) if not has_check(hints[option.name])}
    assert not without


@pytest.mark.parametrize(
    ("make", "options", "message"),
    [
        (Prbs, {"stages": 21, "clock_period": 1.0}, "stages must be an integer from 2 to 20, not 21"),
        (Prbs, {"stages": 10, "clock_period": 1.0, "amplitude": True}, "amplitude must be a positive number"),
        (Step, {"amplitude": 0.0}, "amplitude must not be zero"),
        (Steps, {"times": (0.0, 1.0), "levels": (1.0,)}, "as many as times, and there are 1 of them and 2 times"),
        (Steps, {"times": (1.0, 1.0), "levels": (1.0, 2.0)}, r"must increase from 0 s on; they are \[1.0, 1.0\] s"),
        (Steps, {"times": (0.0,), "levels": (0.0,)}, "levels must not all be zero"),
        (Steps, {"times": (NAN,), "levels": (1.0,)}, r"each of the times must be a finite number \[s\], not nan"),
        (InputFile, {"file": "a.csv", "time": "u"}, "time and input must be two columns; both are 'u'"),
        (Multisine, {}, "lowest_frequency is missing"),
        (Multisine, {"lowest_frequency": 2.0, "highest_frequency": 1.0, "tones": 3}, "they are 2 and 1 rad/s"),
        (Multisine, {"lowest_frequency": 2.0, "highest_frequency": 2.0, "tones": 3}, "3 tones need a band"),
        (Multisine, BAND, "tones is missing, the number of tones; with a period"),
        (Multisine, BAND | {"highest_frequency": 2e9, "period": 9.0}, "beyond harmonic 10000 of"),
        (Multisine, BAND | {"highest_frequency": 1.1, "period": 1.0}, "contains no harmonic of the period"),
        (Multisine, {"frequencies": (1.0, 2.0), "tones": 2}, "tones is of a band, and frequencies are given"),
        (Multisine, {"frequencies": (1.0,), "period": 1e300}, "beyond harmonic 1000000 of the period"),
        (Multisine, {"frequencies": (1.0, 1.1), "period": 6.0}, "two of the frequencies, or their harmonics, are"),
        (WhiteNoise, {}, "exactly one of snr_db .*, standard_deviation .*, variance .*; none was given"),
        (WhiteNoise, {"snr_db": 2000}, "snr_db must be within plus or minus 1000 dB"),
        (ArmaNoise, {"numerator": (1.0,), "denominator": (1.0,)}, "innovation_variance .*; none was given"),
        (ArmaNoise, UNIT | {"denominator": (1.0, -1.0)}, "denominator has a zero of magnitude 1: the noise would grow"),
        (ArmaNoise, UNIT | {"denominator": (0.0, 1.0)}, "the first coefficient of denominator, which belongs"),
        (UniformIntervals, {"low": 0.2, "high": 0.1, "samples": 10}, "must not exceed high; they are 0.2 s and 0.1 s"),
        (JitteredSampling, {"interval": 0.1, "samples": 9, "largest_shift": 0.05}, r"than half the interval, 0\.05 s"),
        (geometric_sizes, {"first": 500, "last": 500, "count": 3}, "must be below the last; they are 500 and 500"),
        (geometric_sizes, {"first": 2, "last": 5, "count": 9}, "no 9 different sizes from 2 to 5"),
        (Tone, {"frequency": (Piece(1.0, 2.0),)}, "the last has none"),
        (Tone, {"frequency": (Piece(1.0, 3.0), Piece(2.0, 2.0), Piece(1.0))}, "follow one another"),
        (SumOfSinusoids, {"tones": ()}, "tones must hold at least one"),
        (SumOfSinusoids, {"tones": (Tone(1.0), Tone((Piece(2.0, 4.0), Piece(1.0))))}, "same frequency from 4 s"),
    ],
)
def test_impossible_options_are_refused(make, options, message):
    with pytest.raises(ValueError, match=message):
        make(**options)
