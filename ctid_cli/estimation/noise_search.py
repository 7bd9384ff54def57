r"""Maximum-likelihood estimates of plant and ARMA noise, from the output-error optimum.

Given the noise, the plant follows by least squares of the innovations; given the plant, the noise follows from the
output errors. Each step increases the likelihood, and at convergence its gradient by all parameters is zero. In open
loop the information matrix is block-diagonal, so that a few rounds suffice.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.estimation.measured_records import MeasuredRecords
from ctid_cli.estimation.optimum.best_model import LONG, Begin, Optimum
from ctid_cli.inference.innovations import NoiseFit, Orders, all_arma, fit_arma, steps_of
from ctid_cli.progress import reported
from ctid_cli.signals.noise import ArmaNoise

#: Decrease of ``-2 ln L`` per round that counts as convergence; largest number of rounds.
SETTLED, MOST_ROUNDS = 1e-6, 40


class Whitenable(Protocol):
    """Records whose errors a noise model whitens, with the minima of their squares; each minimum is a ``start``."""

    def used(self) -> tuple[BoolArray, ...]:
        """Return the mask of the used samples of each record."""

    def errors(self, found: Any) -> list[Array]:
        """Return the errors of a minimum at the used samples of each record, not whitened."""

    def whitened_by(self, noise: ArmaNoise) -> "Whitenable":
        """Return a copy with whitened errors."""

    def local(self, *starts: Any) -> Any:
        """Return the minimum in the basin of a start; None if none is found."""


class JointOptimum(NamedTuple):
    """Plant and noise of the greatest likelihood found."""

    found: Any
    noise: NoiseFit


@reported("noise model")
def joint_optimum(
    measured: MeasuredRecords,
    found: Optimum,
    orders: Orders | None,
    starts: Sequence[Begin],
) -> JointOptimum:
    """Return plant and noise of the greatest likelihood near an output-error optimum; orders by BIC unless given.

    The output-error optimum may have fitted the noise: the plant is searched again by the innovations under that noise,
    in long records only near the optimum.
    """
    joint = joint_near(measured, found, orders)
    if not sum(joint.noise.orders):
        return joint
    white, size = measured.whitened_by(joint.noise.noise), found.start[0].size
    # Structures with poles at infinity are not searched again.
    same_order = [start for start in starts if start[0].size == size]
    starts = [joint.found.start, *same_order]
    search = sum(e.size for e in measured.outputs) <= LONG
    other = white.best(starts) if search else white.local(*starts)
    if other.start[0].size != size:
        return joint
    return min((joint, _settled(measured, JointOptimum(other, joint.noise))), key=lambda each: each.noise.deviance)


def joint_near(measured: Whitenable, found: Any, orders: Orders | None) -> JointOptimum:
    """Return plant and noise in the basin of an output-error optimum."""
    steps = [steps_of(use) for use in measured.used()]
    if orders is not None:
        return _settled(measured, JointOptimum(found, fit_arma(measured.errors(found), steps, orders)))
    fits: dict[Orders, NoiseFit] = {}
    tried: dict[Orders, JointOptimum] = {}
    while True:
        # The output-error fit absorbs part of the noise: repeat with the errors of the joint fit.
        fits = all_arma(measured.errors(found), steps, fits)
        chosen = min(fits.values(), key=lambda fit: fit.bic)
        if chosen.orders in tried:
            return min(tried.values(), key=lambda joint: joint.noise.bic)
        joint = tried[chosen.orders] = _settled(measured, JointOptimum(found, chosen))
        found = joint.found


def _settled(measured: Whitenable, joint: JointOptimum) -> JointOptimum:
    """Estimate plant and noise alternately until the likelihood converges, or no plant is found under the noise."""
    (found, noise), steps = joint, [steps_of(use) for use in measured.used()]
    for _ in range(MOST_ROUNDS if sum(noise.orders) else 0):
        moved = measured.whitened_by(noise.noise).local(found.start)
        if moved is None:
            break
        found = moved
        updated = fit_arma(measured.errors(found), steps, noise.orders, noise)
        settled, noise = noise.deviance - updated.deviance < SETTLED, updated
        if settled:
            break
    return JointOptimum(found, noise)
