"""Models shared by several tests."""

from ctid_cli.models.additive import AdditiveModel, Submodel
from ctid_cli.models.transfer_function import TransferFunction

#: The eighth-order system of the study of sums.
FOUR_MODES = AdditiveModel(
    [
        Submodel([3.0], [0.501354, 0.250677, 1.0]),
        Submodel([0.4], [0.0999191, 0.0299757, 1.0]),
        Submodel([0.2], [0.0300104, 0.0102035, 1.0]),
        Submodel([0.05], [0.00999499, 0.00999499, 1.0]),
    ]
)


def parts(model):
    return [s.transfer_function() for s in model.submodels] if isinstance(model, AdditiveModel) else [model]


def with_delay(model, delay):
    if isinstance(model, AdditiveModel):
        return AdditiveModel(model.submodels, delay)
    return TransferFunction(model.numerator, model.denominator, delay)
