"""Autocovariances of autoregressive noise, for matrices of a whole record."""

import numpy as np

from ctid_cli.signals.noise import ArmaNoise


def autocovariance(model, count):
    noise = ArmaNoise((1.0,), tuple(model.coefficients.tolist()), innovation_variance=model.innovation_variance)
    return noise.autocovariance(np.arange(count))
