"""What an ill-conditioned covariance means, in words."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from ctid_cli.arrays import Array
from ctid_cli.text import listed

#: A coefficient or delay whose standard error exceeds its magnitude by this factor is called undetermined.
LARGE_STANDARD_ERROR = 10.0
#: Beyond this (multiple) correlation, estimates are called hard to tell apart.
CLOSE_TO_ONE = 0.999
#: Beyond this condition number of the scaled matrix ``sum psi psi'`` half the digits are lost: nearly singular.
NEARLY_SINGULAR = 1e8


def describe_conditioning(
    covariance: ArrayLike,
    estimates: ArrayLike,
    names: Sequence[str],
    condition_number: float,
    *,
    hessian: ArrayLike | None = None,
) -> tuple[str, ...]:
    """Sentences on parameters that the data do not determine, none if all is well.

    Three rules. A standard error is not defined, or the condition number exceeds 1e8: the parameters with more than a
    tenth of the singular direction (unit diagonal) are named. A standard error exceeds ten times the magnitude of a
    coefficient or of the delay; initial states and offsets may well be zero and are not looked at. Two estimates have
    a correlation beyond 0.999, or one has such a multiple correlation with several others.
    """
    C = np.asarray(covariance, dtype=float)
    theta = np.asarray(estimates, dtype=float)
    size = theta.size
    sentences: list[str] = []
    variances = np.diag(C)
    defined = bool(np.isfinite(C).all() and (variances > 0).all())

    if not defined or not condition_number <= NEARLY_SINGULAR:
        group = _singular_direction(C, hessian, defined)
        what = listed([names[i] for i in group]) if 0 < len(group) < size else "all the parameters together"
        number = f"condition number {condition_number:.1e}" if np.isfinite(condition_number) else "singular equations"
        if len(group) == 1:
            start = f"{what} has no effect that these data show ({number})"
        else:
            start = f"These data do not determine {what} one by one ({number})"
        end = "their standard errors are not reliable" if defined else "no standard errors can be given"
        sentences.append(f"{start}; {end}. {_advice([names[i] for i in group], names)}")
    if not defined:
        return tuple(sentences)

    errors = np.sqrt(variances)
    for i in range(size):
        if re.fullmatch(r"[ab]\d+|delay", names[i]) and errors[i] > LARGE_STANDARD_ERROR * abs(theta[i]):
            times = f"{errors[i] / abs(theta[i]):.2g} times its value" if theta[i] else "its value being zero"
            sentences.append(
                f"{names[i]} = {theta[i]:.3g} has a standard error of {errors[i]:.3g}, {times}: "
                "these data do not determine it, not even its sign; a simpler model may do."
            )
    if not condition_number <= NEARLY_SINGULAR:
        return tuple(sentences)  # the correlations would say the same again

    correlation = C / np.outer(errors, errors)
    pairs = [(i, j) for i in range(size) for j in range(i) if abs(correlation[i, j]) > CLOSE_TO_ONE]
    for i, j in pairs:
        both = [names[j], names[i]]
        sentences.append(
            f"{both[0]} and {both[1]} can hardly be told apart by these data (correlation {correlation[i, j]:.5f}): "
            f"only a combination of them is well determined. {_advice(both, names)}"
        )
    with np.errstate(invalid="ignore", divide="ignore"):
        multiple = np.sqrt(1.0 - 1.0 / np.diag(np.linalg.inv(correlation)))
    paired = {index for pair in pairs for index in pair}
    group = [i for i in range(size) if multiple[i] > CLOSE_TO_ONE and i not in paired]
    if len(group) > 1:
        several = [names[i] for i in group]
        sentences.append(
            f"{listed(several)} can hardly be told apart by these data (multiple correlations above {CLOSE_TO_ONE}): "
            f"only combinations of them are well determined. {_advice(several, names)}"
        )
    return tuple(sentences)


def _singular_direction(C: Array, hessian: ArrayLike | None, defined: bool) -> list[int]:
    """Parameters with more than a tenth of the direction that changes the output least; none if unknown."""
    if hessian is not None:
        H = np.asarray(hessian, dtype=float)
        diagonal = np.diag(H)
        if not np.isfinite(H).all():
            return []
        silent = np.flatnonzero(diagonal <= 0)
        if silent.size:
            return [int(i) for i in silent]
        scale = 1.0 / np.sqrt(diagonal)
        direction = np.linalg.eigh(H * np.outer(scale, scale))[1][:, 0]
    elif defined:
        scale = 1.0 / np.sqrt(np.diag(C))
        direction = np.linalg.eigh(C * np.outer(scale, scale))[1][:, -1]
    else:
        return []
    return [int(i) for i in np.flatnonzero(np.abs(direction) > 0.1)]


def _advice(group: Sequence[str], names: Sequence[str]) -> str:
    numerator = [name for name in group if re.fullmatch(r"b\d+", name)]
    zeros = sum(bool(re.fullmatch(r"b\d+", name)) for name in names) - 1
    if "delay" in group and numerator and zeros > 0:
        return "A zero and a delay have nearly the same effect here: fix the delay, or use fewer zeros."
    if "delay" in group and numerator:
        return "The input hardly shows when the response begins: fix the delay, or use an input with sharper changes."
    return "Use fewer poles or zeros, or an input that excites the system at more frequencies."
