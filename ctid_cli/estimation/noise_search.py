r"""Plant and ARMA noise of the greatest joint likelihood, from the least output error.

Given the noise, the least squares of the innovations have the plant; given the plant, the output errors have the noise.
Either step raises the likelihood. In open loop the information of both is block-diagonal, so that a few rounds do.
"""

from typing import NamedTuple

from ctid_cli.estimation.measured_records import MeasuredRecords
from ctid_cli.estimation.optimum.best_model import Optimum
from ctid_cli.inference.innovations import NoiseFit, Orders, choose_arma, fit_arma

#: The estimate has settled where a round lowers ``-2 ln L`` by less, and most rounds.
SETTLED, MOST_ROUNDS = 1e-8, 40
#: Most choices of the orders.
MOST_CHOICES = 4


class JointOptimum(NamedTuple):
    """The greatest likelihood that was found."""

    found: Optimum
    noise: NoiseFit


def joint_optimum(measured: MeasuredRecords, found: Optimum, orders: Orders | None) -> JointOptimum:
    """Return plant and noise of the greatest likelihood near an output-error optimum; orders that are not given by BIC."""
    if orders is not None:
        return _of_orders(measured, found, fit_arma(_errors(measured, found), measured.steps, orders))
    chosen = choose_arma(_errors(measured, found), measured.steps)
    for _ in range(MOST_CHOICES):
        joint = _of_orders(measured, found, chosen)
        # The output-error fit has taken a part of the noise with it.
        chosen = choose_arma(_errors(measured, joint.found), measured.steps)
        if chosen.orders == joint.noise.orders:
            break
        found = joint.found
    return joint


def _errors(measured: MeasuredRecords, found: Optimum) -> list:
    return [y - x for y, x in zip(measured.outputs, measured.simulated(found), strict=True)]


def _of_orders(measured: MeasuredRecords, found: Optimum, noise: NoiseFit) -> JointOptimum:
    for _ in range(MOST_ROUNDS):
        found = measured.whitened_by(noise.noise).local((found.denominator, found.delay))
        following = fit_arma(_errors(measured, found), measured.steps, noise.orders, noise)
        settled = noise.deviance - following.deviance < SETTLED
        noise = following
        if settled:
            break
    return JointOptimum(found, noise)
