"""What an ill-conditioned covariance means, in words."""

import re
from collections.abc import Iterator, Sequence

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.text import listed

#: A coefficient or delay whose standard error exceeds its magnitude by this factor is called undetermined.
LARGE_STANDARD_ERROR = 10.0
#: Beyond this (multiple) correlation, estimates are called hard to tell apart.
CLOSE_TO_ONE = 0.999
#: Beyond this condition number of the scaled matrix ``sum psi psi'`` half the digits are lost: nearly singular.
NEARLY_SINGULAR = 1e8


def describe_conditioning(
    covariance: Array, estimates: Array, names: Sequence[str], condition_number: float, hessian: Array
) -> list[str]:
    """Sentences on parameters that the data do not determine, none if all is well.

    Three rules. A standard error is not defined, or the condition number exceeds 1e8: the parameters with more than a
    tenth of the singular direction (unit diagonal) are named. A standard error exceeds ten times the magnitude of a
    coefficient or of the delay; initial states and offsets may well be zero and are not looked at. Two estimates have
    a correlation beyond 0.999, or one has such a multiple correlation with several others.
    """
    variances = np.diag(covariance)
    defined = bool(np.isfinite(covariance).all() and (variances > 0).all())
    sentences: list[str] = []
    singular = not condition_number <= NEARLY_SINGULAR
    if singular or not defined:
        group = [names[i] for i in _singular_direction(hessian)]
        what = listed(group) if 0 < len(group) < len(names) else "all the parameters together"
        number = f"condition number {condition_number:.1e}" if np.isfinite(condition_number) else "singular equations"
        start = f"These data do not determine {what} one by one ({number})"
        if len(group) == 1:
            start = f"{what} has no effect that these data show ({number})"
        end = "their standard errors are not reliable" if defined else "no standard errors can be given"
        sentences.append(f"{start}; {end}. {_advice(group, names)}")
    if defined:
        errors = np.sqrt(variances)
        sentences += _large_errors(estimates, errors, names)
        # Of singular equations the correlations would say the same again.
        sentences += [] if singular else _correlated(covariance / np.outer(errors, errors), names)
    return sentences


def _large_errors(theta: Array, errors: Array, names: Sequence[str]) -> Iterator[str]:
    for name, value, error in zip(names, theta, errors, strict=True):
        if re.fullmatch(r"[ab]\d+|delay", name) and error > LARGE_STANDARD_ERROR * abs(value):
            times = f"{error / abs(value):.2g} times its value" if value else "its value being zero"
            start = f"{name} = {value:.3g} has a standard error of {error:.3g}, {times}"
            yield f"{start}: these data do not determine it, not even its sign; a simpler model may do."


def _correlated(correlation: Array, names: Sequence[str]) -> Iterator[str]:
    def told(group: Sequence[int], how: str, combinations: str) -> str:
        several = [names[i] for i in group]
        start = f"{listed(several)} can hardly be told apart by these data ({how}): only"
        return f"{start} {combinations} well determined. {_advice(several, names)}"

    size = len(names)
    pairs = [(j, i) for i in range(size) for j in range(i) if abs(correlation[i, j]) > CLOSE_TO_ONE]
    for pair in pairs:
        yield told(pair, f"correlation {correlation[pair]:.5f}", "a combination of them is")
    with np.errstate(invalid="ignore", divide="ignore"):
        multiple = np.sqrt(1.0 - 1.0 / np.diag(np.linalg.inv(correlation)))
    paired = {index for pair in pairs for index in pair}
    group = [i for i in range(size) if multiple[i] > CLOSE_TO_ONE and i not in paired]
    if len(group) > 1:
        yield told(group, f"multiple correlations above {CLOSE_TO_ONE}", "combinations of them are")


def _singular_direction(hessian: Array) -> list[int]:
    """Parameters with more than a tenth of the direction that changes the output least; none if unknown."""
    diagonal = np.diag(hessian)
    if not np.isfinite(hessian).all():
        return []
    if (diagonal <= 0).any():
        return np.flatnonzero(diagonal <= 0).tolist()
    scale = 1.0 / np.sqrt(diagonal)
    direction = np.linalg.eigh(hessian * np.outer(scale, scale))[1][:, 0]
    return np.flatnonzero(np.abs(direction) > 0.1).tolist()


def _advice(group: Sequence[str], names: Sequence[str]) -> str:
    numerator = [name for name in group if re.fullmatch(r"b\d+", name)]
    zeros = sum(bool(re.fullmatch(r"b\d+", name)) for name in names) - 1
    if "delay" in group and numerator and zeros > 0:
        return "A zero and a delay have nearly the same effect here: fix the delay, or use fewer zeros."
    if "delay" in group and numerator:
        return "The input hardly shows when the response begins: fix the delay, or use an input with sharper changes."
    return "Use fewer poles or zeros, or an input that excites the system at more frequencies."
