"""Sections whose ``kind`` selects an option dataclass of the floors below."""

from typing import Annotated, Any

from ctid_cli.specification.sections import Kinds, Section

ExcitationSection = Annotated[Section, Kinds("excitation")]
SamplingSection = Annotated[Section, Kinds("sampling")]
NoiseSection = Annotated[Section, Kinds("noise")]
DisturbanceSection = Annotated[Section, Kinds("disturbance")]
EstimatorSection = Annotated[Any, Kinds("estimator", "frequency_estimator")]
