"""Where estimates start: what a start is called, and what it is on a data set."""

from __future__ import annotations

from dataclasses import dataclass, field
from decimal import Decimal
from typing import TYPE_CHECKING, Literal, cast

from ctid_cli.canonical import content_hash
from ctid_cli.estimation.common import Start
from ctid_cli.models.additive import AdditiveModel
from ctid_cli.models.factoring import factored
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.streams import stream

if TYPE_CHECKING:
    from ctid_cli.specification.system_sections import StartsSection


@dataclass(frozen=True)
class StartPoint:
    """A start: an initial delay, initial parameters, or none."""

    label: str
    #: What of an estimate it is a start of.
    of: Literal["delay", "parameters"] | None = None
    #: Initial delay [s], or the word random; None leaves it to the estimator.
    initial_delay: float | str | None = None
    #: Range of a random delay [s].
    bounds: tuple[float, float] | None = None
    #: Largest relative deviation of random parameters from those of the simulated system [-].
    spread: float | None = None
    model: AdditiveModel | None = field(default=None, compare=False)

    def draw(
        self, seed: int | None, replicate: int, true_model: TransferFunction | AdditiveModel | None = None
    ) -> Start | None:
        """The start on one data set.

        Every random start stretches the same numbers of the replicate's stream over its own range, so that no start
        depends on which others there are.
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


#: The start of estimators that need none, and of every estimator where the specification names none.
NO_START = StartPoint("none")


def additive_form(model: TransferFunction | AdditiveModel) -> AdditiveModel:
    """A model as a sum of submodels."""
    return model if isinstance(model, AdditiveModel) else factored(model)


def start_points(section: StartsSection | None) -> tuple[StartPoint, ...]:
    """The starts that a specification names."""
    # A worker draws starts and never reads a section, which would take it half a second to import.
    from ctid_cli.specification.system_sections import RelativeStart, UniformStart

    if section is None:
        return ()
    points: list[StartPoint] = []
    for delay in section.initial_delay or []:
        if isinstance(delay, UniformStart):
            low, high = delay.uniform
            points.append(StartPoint(f"uniform({_short(low)}, {_short(high)})", "delay", "random", (low, high)))
        else:
            points.append(StartPoint(_short(delay), "delay", delay))
    for parameters in section.parameters or []:
        values = parameters.model_dump(mode="json")
        if isinstance(parameters, RelativeStart):
            spread = parameters.relative_uniform
            points.append(StartPoint(f"parameters({_percent(spread)}%)", "parameters", spread=spread))
        else:
            points.append(StartPoint(f"given {content_hash(values)[:8]}", "parameters", model=parameters.options()))
    return tuple(points)


def _short(value: float) -> str:
    """The shortest text that is the number again, without a trailing ``.0``."""
    return repr(value).removesuffix(".0")


def _percent(value: float) -> str:
    """A fraction in percent, as exactly as the fraction was written."""
    return f"{(100 * Decimal(repr(value))).normalize():f}"
