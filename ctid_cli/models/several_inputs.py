"""Models with several inputs: one transfer function for each input; the responses are added."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ctid_cli.arrays import ComplexArray
from ctid_cli.models.additive import AdditiveModel
from ctid_cli.models.transfer_function import TransferFunction


@dataclass(frozen=True, eq=False)
class MultiInputModel:
    """Sum of the responses to several inputs."""

    #: The transfer function of each input, with its delay [s].
    parts: Mapping[str, TransferFunction]
    #: Whether all have a common denominator.
    common: bool

    @property
    def order(self) -> int:
        """Number of poles; those of a common denominator count once."""
        return self.poles.size

    @property
    def poles(self) -> ComplexArray:
        """The poles of all denominators [rad/s]."""
        different = list(self.parts.values())[: 1 if self.common else None]
        return np.concatenate([part.poles for part in different])


#: A model of records.
AnyModel = TransferFunction | MultiInputModel


def fractions_of(model: AnyModel) -> tuple[TransferFunction, ...]:
    """Return the transfer functions of all inputs."""
    return tuple(model.parts.values()) if isinstance(model, MultiInputModel) else (model,)


def delays_of(model: AnyModel | AdditiveModel) -> list[float]:
    """Return the delay of each input [s]."""
    if isinstance(model, AdditiveModel):
        return [model.delay]
    return [one.delay for one in fractions_of(model)]
