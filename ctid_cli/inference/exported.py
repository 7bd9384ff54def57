"""An estimated model as an object or a text of other tools."""

import re

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import UsageError
from ctid_cli.inference.bands import SystemWithDelay
from ctid_cli.inference.responses import Estimated
from ctid_cli.models.transfer_function import TransferFunction

#: What MATLAB calls units of time, by the labels that files use.
MATLAB_UNITS = {
    **dict.fromkeys(("s", "sec", "second", "seconds"), "seconds"),
    **dict.fromkeys(("ms", "millisecond", "milliseconds"), "milliseconds"),
    **dict.fromkeys(("us", "µs", "μs", "microsecond", "microseconds"), "microseconds"),
    **dict.fromkeys(("ns", "nanosecond", "nanoseconds"), "nanoseconds"),
    **dict.fromkeys(("min", "minute", "minutes"), "minutes"),
    **dict.fromkeys(("h", "hr", "hour", "hours"), "hours"),
    **dict.fromkeys(("d", "day", "days"), "days"),
}
#: How the delay is called in each kind of object.
DELAYS = {"idtf": "IODelay", "tf": "InputDelay"}


def to_control(model: TransferFunction, pade: int | None) -> SystemWithDelay:
    """For python-control."""
    try:
        import control
    except ImportError:
        raise UsageError("python-control is not installed: pip install 'ctid[control]'") from None
    if pade is not None and pade < 1:
        raise UsageError(f"the order of a Padé approximation must be at least 1; got {pade}")
    system = control.TransferFunction(model.numerator.tolist(), model.denominator.tolist())
    if pade is None or not model.delay:
        return SystemWithDelay(system, model.delay)
    return SystemWithDelay(system * control.TransferFunction(*control.pade(model.delay, pade)), 0.0)


def to_scipy(model: TransferFunction) -> SystemWithDelay:
    """For SciPy."""
    from scipy.signal import TransferFunction as ScipyTransferFunction

    return SystemWithDelay(ScipyTransferFunction(model.numerator, model.denominator), model.delay)


def to_matlab(found: Estimated, name: str, kind: str, time_unit: str) -> str:
    """For MATLAB."""
    if not re.fullmatch(r"[A-Za-z]\w{0,62}", name, re.ASCII):
        raise UsageError(f"a variable of MATLAB is a letter, then letters, digits and underscores; got {name!r}")
    if kind not in DELAYS:
        raise UsageError(f"the kind of a MATLAB model is {' or '.join(DELAYS)}; got {kind!r}")
    unit = MATLAB_UNITS.get(time_unit)
    if unit is None:
        raise UsageError(
            f"MATLAB has no unit of time {time_unit!r}; it has {', '.join(dict.fromkeys(MATLAB_UNITS.values()))}"
        )
    model = found.parametric.fraction
    lines = [
        f"% {name}(s) = B(s)/A(s) exp(-delay s), coefficients in descending powers of s",
        f"numerator = {_row(model.numerator)};",
        f"denominator = {_row(model.denominator)};",
        f"delay = {model.delay!r};",
        f"{name} = {kind}(numerator, denominator, '{DELAYS[kind]}', delay, 'TimeUnit', '{unit}');",
        f"% covariance of the estimates of {', '.join(found.parametric.names)}:",
        *(f"%   {_row(row)}" for row in found.reported),
    ]
    return "\n".join(lines) + "\n"


def _row(values: Array) -> str:
    """Numbers with all their digits."""
    return f"[{' '.join('NaN' if np.isnan(value) else repr(value) for value in values.tolist())}]"
