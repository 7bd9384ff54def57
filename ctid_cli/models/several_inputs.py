"""Models with several inputs: one transfer function for each input; the responses are added."""

from collections.abc import Iterable, Mapping
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

    @classmethod
    def of(cls, parts: Mapping[str, TransferFunction]) -> "MultiInputModel":
        """Return the model of some transfer functions, which share a denominator where all are equal."""
        first, *others = parts.values()
        return cls(parts, all(np.array_equal(first.denominator, other.denominator) for other in others))

    @property
    def parameters(self) -> dict[str, float]:
        """Coefficients and delays by name: ``u1_a1``, or ``a1`` of a common denominator, ``u1_b0``, ``u1_delay``."""
        found = {
            name if self.common and name.startswith("a") else f"{own}_{name}": value
            for own, part in self.parts.items()
            for name, value in part.parameters.items()
        }
        return found | {f"{own}_delay": part.delay for own, part in self.parts.items()}

    @property
    def order(self) -> int:
        """Number of poles; those of a common denominator count once."""
        return self.poles.size

    @property
    def poles(self) -> ComplexArray:
        """The poles of all denominators [rad/s]."""
        different = list(self.parts.values())[: 1 if self.common else None]
        return np.concatenate([part.poles for part in different])


#: Transfer functions of one input or of several.
AnyModel = TransferFunction | MultiInputModel
#: Any model of a system, a sum of submodels among them.
SystemModel = AnyModel | AdditiveModel


def fractions_of(model: AnyModel) -> tuple[TransferFunction, ...]:
    """Return the transfer functions of all inputs."""
    return tuple(model.parts.values()) if isinstance(model, MultiInputModel) else (model,)


def parts_of(
    model: SystemModel, inputs: Iterable[str]
) -> Mapping[str, TransferFunction] | dict[str, TransferFunction | AdditiveModel]:
    """Return the model of each input by its name."""
    return model.parts if isinstance(model, MultiInputModel) else dict.fromkeys(inputs, model)


def parameters_of(model: SystemModel) -> dict[str, float]:
    """Return coefficients and delays by name."""
    if isinstance(model, MultiInputModel):
        return model.parameters
    return {**model.parameters, "delay": model.delay}


def is_delay(name: str) -> bool:
    """Return whether a parameter of this name is a delay, that of one of several inputs among them."""
    return name == "delay" or name.endswith("_delay")


def delays_of(model: SystemModel) -> list[float]:
    """Return the delay of each input [s]."""
    if isinstance(model, AdditiveModel):
        return [model.delay]
    return [one.delay for one in fractions_of(model)]
