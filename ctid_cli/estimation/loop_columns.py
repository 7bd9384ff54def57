"""Signals of a simulated loop that enter sums: sensitivities, free responses and output errors, or innovations."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.filtering.filter_data import FilterData
from ctid_cli.filtering.loop_response import LoopResponse
from ctid_cli.inference.innovations import SampledNoise, steps_of
from ctid_cli.inference.loop_noise import SensitivityFunction
from ctid_cli.signals.noise import ArmaNoise

#: Relative singular value below which directions of state and offset are dropped.
RANK = 1e-10
#: Step of central differences by parameters of the sensitivity function, relative if they are above one.
STEP = 1e-6


class Columns(NamedTuple):
    """Signals of an estimate at each used sample."""

    #: Sensitivities to the parameters, shape (count, p).
    slopes: Array
    #: Responses to the first state, and ones if an offset is estimated, shape (count, f).
    linear: Array
    #: Measured output minus the response to the reference, shape (count,).
    left: Array

    @property
    def basis(self) -> tuple[Array, Array]:
        """Orthonormal basis of the linear columns, and the matrix that combines the columns to it."""
        if not self.linear.shape[1]:
            return self.linear, np.zeros((0, 0))
        lengths = np.linalg.norm(self.linear, axis=0)
        lengths[lengths == 0.0] = 1.0
        U, s, Vt = np.linalg.svd(self.linear / lengths, full_matrices=False)
        kept = s > RANK * s[0]
        return U[:, kept], (Vt[kept] / s[kept, None]).T / lengths[:, None]

    @property
    def own(self) -> Array:
        """Least-squares state and offset."""
        Q, combined = self.basis
        return np.asarray(combined @ (Q.T @ self.left))


class LoopPart(NamedTuple):
    """One record, and the response of the loop to its reference."""

    data: FilterData
    response: LoopResponse


def stacked(each: Sequence[Columns]) -> Columns:
    """Return the columns of several records, each with its own state and offset."""
    if len(each) == 1:
        return each[0]
    own, ends = each[0].linear.shape[1], np.cumsum([columns.left.size for columns in each])
    linear = np.zeros((ends[-1], own * len(each)))
    for k, (end, columns) in enumerate(zip(ends, each, strict=True)):
        linear[end - columns.left.size : end, own * k : own * (k + 1)] = columns.linear
    slopes, left = (np.concatenate(parts) for parts in zip(*((c.slopes, c.left) for c in each), strict=True))
    return Columns(slopes, linear, left)


def as_innovations(columns: Columns, theta: Array, response: LoopResponse, noise: ArmaNoise | None) -> Columns:
    """Return the columns as innovations.

    The output error of a loop is S v. S has the unstable poles of the plant as zeros; removing S with these zeros
    reflected leaves v filtered by an all-pass, which is white if v is, and uncorrelated with past inputs and
    outputs of the record (U. Forssell and L. Ljung, *Identification of unstable systems using output error and
    Box-Jenkins model structures*, IEEE Trans. Automatic Control 45 (2000) 137-141).
    """

    def loop_at(near: Array) -> SensitivityFunction:
        found = response.sensitivity(near)
        assert found is not None
        return SensitivityFunction.of(*found)

    removed = loop_at(theta).removed
    white = Columns(*(removed(signal) if signal.size else signal for signal in columns))
    left = columns.left - columns.linear @ white.own
    for j in range(white.slopes.shape[1]):
        step = STEP * max(1.0, abs(theta[j])) * np.eye(theta.size)[j]
        white.slopes[:, j] -= (loop_at(theta + step).removed(left) - loop_at(theta - step).removed(left)) / (
            2.0 * step[j]
        )
    if noise is None:
        return white
    sampled = SampledNoise(noise, steps_of(np.ones(left.size, dtype=bool)))
    return Columns(*(sampled.whitened(signal) if signal.size else signal for signal in white))
