r"""Plant and ARMA noise of the greatest joint likelihood, from the least output error.

Given the noise, the least squares of the innovations have the plant; given the plant, the output errors have the noise.
Either step raises the likelihood, and where neither does any more its slope by all parameters is zero. In open loop
the information on both is block-diagonal, so that a few rounds do.
"""

from collections.abc import Sequence
from typing import NamedTuple

from ctid_cli.arrays import Array
from ctid_cli.estimation.measured_records import MeasuredRecords
from ctid_cli.estimation.optimum.best_model import LONG, Optimum, Start, poles_of_start
from ctid_cli.inference.innovations import NoiseFit, Orders, all_arma, fit_arma, steps_of

#: The estimate has settled where a round lowers ``-2 ln L`` by less; most rounds.
SETTLED, MOST_ROUNDS = 1e-6, 40


class JointOptimum(NamedTuple):
    """The greatest likelihood that was found."""

    found: Optimum
    noise: NoiseFit


def joint_optimum(
    measured: MeasuredRecords,
    found: Optimum,
    orders: Orders | None,
    starts: Sequence[Start],
    *,
    nested: bool,
) -> JointOptimum:
    """Plant and noise of the greatest likelihood near an output-error optimum; orders that are not given by BIC.

    The least output error may have followed the noise: the plant is searched once more as the innovations under that
    noise see it, from the starts of the output-error search, and if nested from the smaller plants too.
    """
    joint = _near(measured, found, orders)
    if not sum(joint.noise.orders):
        return joint
    white, size = measured.whitened_by(joint.noise.noise), poles_of_start(found.start).size
    # Poles that have run to infinity are not looked for again.
    alike = [start for start in starts if poles_of_start(start).size == size]
    starts = [joint.found.start, *alike]
    nested = nested and sum(e.size for e in measured.outputs) <= LONG
    other = white.best(starts, nested) if nested else white.local(*starts)
    if poles_of_start(other.start).size != size:
        return joint
    return min((joint, _settled(measured, JointOptimum(other, joint.noise))), key=lambda each: each.noise.deviance)


def _near(measured: MeasuredRecords, found: Optimum, orders: Orders | None) -> JointOptimum:
    """Plant and noise in the basin of an output-error optimum."""
    steps = [steps_of(use) for use in measured.used()]
    if orders is not None:
        return _settled(measured, JointOptimum(found, fit_arma(_errors(measured, found), steps, orders)))
    fits: dict[Orders, NoiseFit] = {}
    tried: dict[Orders, JointOptimum] = {}
    while True:
        # The output-error fit has taken a part of the noise with it: once more from the joint one.
        fits = all_arma(_errors(measured, found), steps, fits)
        chosen = min(fits.values(), key=lambda fit: fit.bic)
        if chosen.orders in tried:
            return min(tried.values(), key=lambda joint: joint.noise.bic)
        joint = tried[chosen.orders] = _settled(measured, JointOptimum(found, chosen))
        found = joint.found


def _errors(measured: MeasuredRecords, found: Optimum) -> list[Array]:
    return [y - x for y, x in zip(measured.outputs, measured.simulated(found), strict=True)]


def _settled(measured: MeasuredRecords, joint: JointOptimum) -> JointOptimum:
    """Plant and noise in turn, until the likelihood rises no further."""
    (found, noise), steps = joint, [steps_of(use) for use in measured.used()]
    for _ in range(MOST_ROUNDS if sum(noise.orders) else 0):
        found = measured.whitened_by(noise.noise).local(found.start)
        following = fit_arma(_errors(measured, found), steps, noise.orders, noise)
        settled, noise = noise.deviance - following.deviance < SETTLED, following
        if settled:
            break
    return JointOptimum(found, noise)
