"""Starts of estimates: their labels, and their values on a data set."""

from dataclasses import dataclass, field
from typing import Literal, cast

from ctid_cli.estimation.common import Start
from ctid_cli.models.additive import AdditiveModel
from ctid_cli.models.factoring import factored
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.noise import stream


@dataclass(frozen=True)
class StartPoint:
    """A start: an initial delay, initial parameters, or none."""

    label: str
    #: Part of the estimate that it initialises.
    of: Literal["delay", "parameters"] | None = None
    #: Initial delay [s], or "random"; None leaves it to the estimator.
    initial_delay: float | str | None = None
    #: Range of a random delay [s].
    bounds: tuple[float, float] | None = None
    #: Largest relative deviation of random parameters from those of the simulated system [-].
    spread: float | None = None
    model: AdditiveModel | None = field(default=None, compare=False)

    def draw(
        self, seed: int | None, replicate: int, true_model: TransferFunction | AdditiveModel | None = None
    ) -> Start | None:
        """Return the start on one data set.

        Every random start scales the same numbers of the replicate's stream to its range, so that no start depends on
        the other starts of the experiment.
        """
        if seed is None and (self.bounds is not None or self.spread is not None):
            raise ValueError("a random start needs the seed of the experiment")
        if self.bounds is not None:
            low, high = self.bounds
            return Start(delay=low + (high - low) * float(stream(cast(int, seed), "start", replicate).random()))
        if self.spread is not None:
            centre = additive_form(cast(AdditiveModel, true_model))
            numbers = stream(cast(int, seed), "parameters", replicate).uniform(-1.0, 1.0, centre.theta.size)
            theta = centre.theta * (1 + self.spread * numbers)
            return Start(model=AdditiveModel.from_theta(theta, centre.terms, centre.delay))
        if self.of is None:
            return None
        return Start(delay=cast(float | None, self.initial_delay), model=self.model)


#: Start of estimators that need none, and default start of all estimators.
NO_START = StartPoint("none")


def additive_form(model: TransferFunction | AdditiveModel) -> AdditiveModel:
    """Return a model as a sum of submodels."""
    return model if isinstance(model, AdditiveModel) else factored(model)
