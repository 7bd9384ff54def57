"""Sections of experiments on the frequencies of a signal: the signal, its disturbance and its clock."""

from typing import Annotated, ClassVar, Literal

from pydantic import BeforeValidator

from ctid_cli.errors import OptionError
from ctid_cli.signals.sampling import RegularSampling
from ctid_cli.signals.sinusoids import SumOfSinusoids
from ctid_cli.specification.fields import Positive, Swept
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
