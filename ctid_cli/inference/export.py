"""An estimated model as an object or a text of other tools."""

import keyword
import re

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import UsageError
from ctid_cli.inference.model_responses import Estimated, SystemWithDelay
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
#: Module of each library, and the name it is imported by.
LIBRARIES: dict[str, tuple[str, str | None]] = {"control": ("control", None), "scipy": ("scipy.signal", "signal")}


def to_control(model: TransferFunction, pade: int | None) -> SystemWithDelay:
    """For python-control."""
    try:
        import control
    except ImportError:
        raise UsageError("python-control is not installed: pip install 'ctid[control]'") from None
    _check_pade(pade)
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


def to_python(found: Estimated, name: str, library: str, pade: int | None) -> str:
    """Code that builds the model with python-control or SciPy."""
    if not name.isidentifier() or keyword.iskeyword(name):
        raise UsageError(f"a variable of Python is a letter, then letters, digits and underscores; got {name!r}")
    _check_pade(pade)
    model = found.parametric.fraction
    module, alias = LIBRARIES[library]
    lines = [
        f"# {name}(s) = B(s)/A(s) exp(-delay s), coefficients in descending powers of s",
        f"import {module}" if alias is None else f"from {module.rpartition('.')[0]} import {alias}",
        "",
        f"numerator = {model.numerator.tolist()!r}",
        f"denominator = {model.denominator.tolist()!r}",
        f"delay = {model.delay!r}  # not part of {name}",
        f"{name} = {alias or module}.TransferFunction(numerator, denominator)",
    ]
    if pade is not None:
        lines[-2] = f"delay = {model.delay!r}"
        lines.append(f"{name} *= control.TransferFunction(*control.pade(delay, {pade}))  # the delay, approximately")
    lines.append(f"# covariance of the estimates of {', '.join(found.parametric.names)}:")
    return "\n".join([*lines, *(f"#   {_row(row)}" for row in found.reported)]) + "\n"


def _check_pade(order: int | None) -> None:
    if order is not None and order < 1:
        raise UsageError(f"the order of a Padé approximation must be at least 1; got {order}")


def _row(values: Array) -> str:
    """Numbers with all their digits."""
    return f"[{' '.join('NaN' if np.isnan(value) else repr(value) for value in values.tolist())}]"
