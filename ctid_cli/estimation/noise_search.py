r"""Plant and ARMA noise of the greatest joint likelihood, from the least output error.

Given the noise, the least squares of the innovations have the plant; given the plant, the output errors have the noise.
Either step raises the likelihood, and where neither does any more its slope by all parameters is zero. In open loop
the information on both is block-diagonal, so that a few rounds do.
"""

from typing import NamedTuple

from ctid_cli.estimation.measured_records import MeasuredRecords
from ctid_cli.estimation.optimum.best_model import Optimum
from ctid_cli.inference.innovations import NoiseFit, Orders, choose_arma, fit_arma, steps_of

#: The estimate has settled where a round lowers ``-2 ln L`` by less; most rounds, and most choices of orders.
SETTLED, MOST_ROUNDS, MOST_CHOICES = 1e-8, 40, 4


class JointOptimum(NamedTuple):
    """The greatest likelihood that was found."""

    found: Optimum
    noise: NoiseFit


def joint_optimum(measured: MeasuredRecords, found: Optimum, orders: Orders | None) -> JointOptimum:
    """Plant and noise of the greatest likelihood near an output-error optimum; orders that are not given by BIC."""
    joint = JointOptimum(found, _noise_of(measured, found, orders))
    for _ in range(MOST_CHOICES):
        joint = _settled(measured, joint)
        if orders is not None:
            break
        # The output-error fit has taken a part of the noise with it.
        chosen = _noise_of(measured, joint.found, None)
        if chosen.orders == joint.noise.orders:
            break
        joint = JointOptimum(joint.found, chosen)
    return joint


def _noise_of(measured: MeasuredRecords, found: Optimum, orders: Orders | None, *near: NoiseFit) -> NoiseFit:
    """Noise of the output errors of a plant."""
    errors = [y - x for y, x in zip(measured.outputs, measured.simulated(found), strict=True)]
    steps = [steps_of(use) for use in measured.used()]
    return choose_arma(errors, steps) if orders is None else fit_arma(errors, steps, orders, *near)


def _settled(measured: MeasuredRecords, joint: JointOptimum) -> JointOptimum:
    """Plant and noise in turn, until the likelihood rises no further."""
    found, noise = joint
    for _ in range(MOST_ROUNDS if sum(noise.orders) else 0):
        found = measured.whitened_by(noise.noise).local((found.denominator, found.delay))
        following = _noise_of(measured, found, noise.orders, noise)
        settled, noise = noise.deviance - following.deviance < SETTLED, following
        if settled:
            break
    return JointOptimum(found, noise)
