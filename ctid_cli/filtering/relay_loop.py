"""A continuous-time model in a loop with a relay that looks and switches at the sampling instants; exact there."""

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError
from ctid_cli.filtering import kernels
from ctid_cli.filtering.loop import LoopSignals
from ctid_cli.filtering.sampled import sampled_model
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
    u, x = kernels.relay_signals((*plant,), reference, noise, before, relay.amplitude, relay.hysteresis, relay.bias)
    if not np.isfinite(x).all():
        raise DataError("the signals of the loop with the relay are not finite; check the system and the reference")
    return LoopSignals(u, x)
