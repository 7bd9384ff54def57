"""Sections of experiments on the frequencies of a signal: the signal, its disturbance, and what is stored of tracks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import Field

from ctid_cli.errors import OptionError
from ctid_cli.kinds import classes
from ctid_cli.signals.sampling import RegularSampling
from ctid_cli.signals.sinusoids import SumOfSinusoids
from ctid_cli.specification.option_sections import SamplingSection, check_of
from ctid_cli.specification.sections import (
    Complaint,
    Section,
    by_kind,
    checked,
    choice,
    list_of,
    number,
    optional,
    section_for,
    several_wrong,
    swept,
    whole,
)

_SECONDS = swept(number("s", above=0.0))

if TYPE_CHECKING:
    SignalSection = Section
    DisturbanceSection = Section
    DisturbanceOrNone = Section
else:
    SignalSection = section_for(SumOfSinusoids)
    DisturbanceSection = by_kind(
        {kind: section_for(target, kind=kind) for kind, target in classes("disturbance").items()}
    )
    DisturbanceOrNone = DisturbanceSection | Literal["none"]


def disturbance_section(value: Any) -> Section | None:
    """Check of the disturbance."""
    section: Section | None = None if value is None or value == "none" else _disturbance(value)
    return section


class RegularDurationSection(Section):
    """Samples at equal intervals, from 0 s, as many as fit into a time."""

    target: ClassVar[type | None] = RegularSampling
    sweepable: ClassVar[frozenset[str]] = frozenset({"interval", "duration"})

    kind: Annotated[Literal["regular"], checked(choice("regular"))] = Field(description="Which one it is")
    interval: Annotated[float | list[float], checked(_SECONDS)] = Field(description="Sampling interval [s]")
    duration: Annotated[float | list[float], checked(_SECONDS)] = Field(
        description="Length of the record, in place of the number of samples [s]"
    )

    def build(self, values: Mapping[str, Any]) -> RegularSampling:
        """The sampling scheme."""
        if not values["duration"] >= 2.0 * values["interval"]:
            raise OptionError(
                "duration",
                f"duration must be at least two sampling intervals of {values['interval']:g} s, "
                f"not {values['duration']:g} s.",
            )
        # Beyond the largest whole number of samples any number of them is refused as too many.
        return RegularSampling(values["interval"], int(min(round(values["duration"] / values["interval"]), 2**62)))


def sampling_section(value: Any) -> Section:
    """Check of the sampling scheme, with a number of samples or a duration."""
    if isinstance(value, RegularDurationSection):
        return value
    if not isinstance(value, Mapping) or value.get("kind") != "regular" or "duration" not in value:
        section: Section = _sampling(value)
        return section
    if "samples" in value:
        message = "gives the length a second time, 'duration' has it already; keep one of the two"
        raise several_wrong("sampling", [(("samples",), message, True)])
    return RegularDurationSection.model_validate(value)


_sampling = check_of(SamplingSection)
_disturbance = check_of(DisturbanceSection)
if TYPE_CHECKING:
    AnySamplingSection = Section
else:
    AnySamplingSection = SamplingSection | RegularDurationSection


class TracksSection(Section):
    """What is stored of the frequencies over time, and where their errors are measured."""

    interval: Annotated[float, checked(number("s", above=0.0))] = Field(
        default=0.05, description="Time from one stored estimate to the next [s]"
    )
    window: Annotated[
        list[float] | None,
        checked(optional(list_of(number("s", at_least=0.0), "a list of 2 numbers [s]", length=2))),
    ] = Field(default=None, description="First and last instant of the window of rms and bias [s]; the last 10 s")
    runs: Annotated[int, checked(whole(at_least=0, at_most=1_000_000))] = Field(
        default=1, description="Store the tracks of so many data sets of every data cell"
    )

    def complaints(self) -> Iterator[Complaint]:
        """Say that the window is empty."""
        if self.window is not None and not self.window[0] < self.window[1]:
            yield ("window",), f"must begin before it ends; it runs from {self.window[0]:g} to {self.window[1]:g} s"
