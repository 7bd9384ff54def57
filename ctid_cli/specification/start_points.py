"""Where estimates start: what a start is called, and what it is on a data set."""

from __future__ import annotations

from dataclasses import dataclass, field
from decimal import Decimal
from typing import ClassVar, cast

from ctid_cli.canonical import content_hash
from ctid_cli.estimation.common import Start
from ctid_cli.models.additive import AdditiveModel
from ctid_cli.models.factoring import factored
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.streams import stream
from ctid_cli.specification.start_sections import RelativeStart, StartsSection, UniformStart


@dataclass(frozen=True)
class StartPoint:
    """An initial delay, or none."""

    label: str
    #: Initial delay [s]; None leaves it to the estimator.
    initial_delay: float | str | None
    #: Range of a random one [s].
    bounds: tuple[float, float] | None = None

    def draw(
        self, seed: int | None, replicate: int, true_model: TransferFunction | AdditiveModel | None = None
    ) -> Start | None:
        """The start on one data set.

        Every random start stretches the first number of the replicate's stream over its own range, so that no start
        depends on which others there are.
        """
        if self.bounds is not None:
            if seed is None:
                raise ValueError("a random start needs the seed of the experiment")
            low, high = self.bounds
            return Start(delay=low + (high - low) * float(stream(seed, "start", replicate).random()))
        return None if self.initial_delay is None else Start(delay=cast(float, self.initial_delay))


@dataclass(frozen=True)
class ParameterStart:
    """Initial parameters."""

    #: There is none, but every start is asked for it.
    initial_delay: ClassVar[None] = None

    label: str
    #: Largest relative deviation from the parameters of the simulated system [-].
    spread: float | None = None
    model: AdditiveModel | None = field(default=None, compare=False)

    def draw(
        self, seed: int | None, replicate: int, true_model: TransferFunction | AdditiveModel | None = None
    ) -> Start:
        """The start on one data set.

        Every random start stretches the same numbers of the replicate's stream over its own range.
        """
        if self.spread is None:
            return Start(model=self.model)
        if seed is None or true_model is None:
            raise ValueError("random initial parameters need the seed of the experiment and the simulated system")
        centre = additive_form(true_model)
        factors = 1 + self.spread * stream(seed, "parameters", replicate).uniform(-1.0, 1.0, centre.theta.size)
        return Start(model=AdditiveModel.from_theta(centre.theta * factors, centre.terms, centre.delay))


#: The start of estimators that need none, and of every estimator where the specification names none.
NO_START = StartPoint("none", None)

AnyStart = StartPoint | ParameterStart


def additive_form(model: TransferFunction | AdditiveModel) -> AdditiveModel:
    """A model as a sum of submodels."""
    return model if isinstance(model, AdditiveModel) else factored(model)


def start_points(section: StartsSection | None) -> tuple[AnyStart, ...]:
    """The starts that a specification names."""
    if section is None:
        return ()
    points: list[AnyStart] = []
    for delay in section.initial_delay or []:
        if isinstance(delay, UniformStart):
            low, high = delay.uniform
            points.append(StartPoint(f"uniform({_short(low)}, {_short(high)})", "random", (low, high)))
        else:
            points.append(StartPoint(_short(delay), delay))
    for parameters in section.parameters or []:
        values = parameters.model_dump(mode="json")
        if isinstance(parameters, RelativeStart):
            spread = parameters.relative_uniform
            points.append(ParameterStart(f"parameters({_percent(spread)}%)", spread))
        else:
            points.append(ParameterStart(f"given {content_hash(values)[:8]}", model=parameters.options()))
    return tuple(points)


def _short(value: float) -> str:
    """The shortest text that is the number again, without a trailing ``.0``."""
    return repr(value).removesuffix(".0")


def _percent(value: float) -> str:
    """A fraction in percent, as exactly as the fraction was written."""
    return f"{(100 * Decimal(repr(value))).normalize():f}"
