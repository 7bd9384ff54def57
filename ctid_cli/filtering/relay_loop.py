"""A continuous-time model in a loop with a relay that looks and switches at the sampling instants; exact there."""

import numpy as np
from numba import njit

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError
from ctid_cli.filtering.loop import LoopSignals
from ctid_cli.filtering.sampled import SampledModel, sampled_model
from ctid_cli.models.additive import AdditiveModel
from ctid_cli.models.relay import Relay
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.record import Enters


def simulate_relay(
    model: AdditiveModel | TransferFunction,
    relay: Relay,
    reference: Array,
    noise: Array,
    interval: float,
    enters: Enters = "controller",
) -> LoopSignals:
    """Input and noise-free output of a loop with a relay that is at rest before the first sample."""
    plant = sampled_model(model, interval)
    if plant.shift == 0 and plant.direct != 0.0:
        raise DataError("a relay needs a model that does not act at once: give it a delay, or fewer zeros than poles")
    before = float(enters == "controller")
    u, x = _relay_loop(plant, reference, noise, before, relay.amplitude, relay.hysteresis, relay.bias)
    if not np.isfinite(x).all():
        raise DataError("the signals of the loop with the relay are not finite; check the system and the reference")
    return LoopSignals(u, x)


@njit(cache=True, nogil=True)
def _relay_loop(
    plant: SampledModel, r: Array, v: Array, before: float, amplitude: float, hysteresis: float, bias: float
) -> tuple[Array, Array]:
    """Compiled body of :func:`simulate_relay`; ``before`` is the share of r that the relay sees, 1 or 0."""
    F, g, c, direct, shift = plant
    n = g.size
    u, x = np.empty(r.size), np.empty(r.size)
    z, z_next = np.zeros(n), np.zeros(n)
    side = 1.0
    for k in range(r.size):
        # Without a delay nothing of the present input is in the output yet, and `direct` is zero.
        arriving = u[k - shift] if 0 < shift <= k else 0.0
        x[k] = direct * arriving
        for i in range(n):
            x[k] += c[i] * z[i]
        error = before * r[k] - x[k] - v[k]
        # Within the hysteresis the relay stays as it is.
        if error > hysteresis:
            side = 1.0
        elif error < -hysteresis:
            side = -1.0
        u[k] = (1.0 - before) * r[k] + bias + amplitude * side
        if shift == 0:
            arriving = u[k]
        for i in range(n):
            z_next[i] = g[i] * arriving
            for j in range(n):
                z_next[i] += F[i, j] * z[j]
        z, z_next = z_next, z
    return u, x
