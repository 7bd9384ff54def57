"""Sections of experiments on the frequencies of a signal: the signal, its disturbance, and what is stored of tracks."""

from collections.abc import Iterator
from typing import Annotated, ClassVar, Literal

from pydantic import BeforeValidator, Field

from ctid_cli.errors import OptionError
from ctid_cli.signals.sampling import RegularSampling
from ctid_cli.signals.sinusoids import SumOfSinusoids
from ctid_cli.specification.fields import NotNegative, Positive, Swept
from ctid_cli.specification.messages import Complaint
from ctid_cli.specification.option_sections import DisturbanceSection, SamplingSection
from ctid_cli.specification.sections import Options, Section, WithKey


class RegularDurationSection(Section):
    """Samples at equal intervals, from 0 s, as many as fit into a time.

    Parameters
    ----------
    kind : {"regular"}
        Which one it is
    interval : float
        Sampling interval [s]
    duration : float
        Length of the record, in place of the number of samples [s]
    """

    target: ClassVar[type | None] = RegularSampling
    elsewhere = {"samples": "gives the length a second time, 'duration' has it already; keep one of the two"}  # noqa: RUF012

    kind: Literal["regular"]
    interval: Annotated[float | list[float], Swept(Positive)]
    duration: Annotated[float | list[float], Swept(Positive)]

    def build(self) -> RegularSampling:
        """The sampling scheme."""
        interval, duration = self.part("interval"), self.part("duration")
        if not duration >= 2.0 * interval:
            message = f"duration must be at least two sampling intervals of {interval:g} s, not {duration:g} s."
            raise OptionError("duration", message)
        # Beyond the largest whole number of samples any number of them is refused as too many.
        return RegularSampling(interval, int(min(round(duration / interval), 2**62)))


SignalSection = Annotated[Section, Options(SumOfSinusoids)]
DisturbanceOrNone = Annotated[
    DisturbanceSection | None, BeforeValidator(lambda value: None if value == "none" else value)
]
AnySamplingSection = Annotated[Section, WithKey("duration", RegularDurationSection, SamplingSection, kind="regular")]


class TracksSection(Section):
    """What is stored of the frequencies over time, and where their errors are measured.

    Parameters
    ----------
    interval : float, default 0.05
        Time from one stored estimate to the next [s]
    window : list of float, optional
        First and last instant of the window of rms and bias [s]; the last 10 s
    runs : int, default 1
        Store the tracks of so many data sets of every data cell
    """

    interval: Positive = 0.05
    window: Annotated[list[NotNegative], Field(min_length=2, max_length=2)] | None = None
    runs: int = Field(default=1, ge=0, le=1_000_000)

    def complaints(self) -> Iterator[Complaint]:
        """Say that the window is empty."""
        if self.window is not None and not self.window[0] < self.window[1]:
            yield ("window",), f"must begin before it ends; it runs from {self.window[0]:g} to {self.window[1]:g} s"
