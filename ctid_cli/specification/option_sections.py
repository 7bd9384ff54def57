"""Sections whose ``kind`` selects an option dataclass of the floors below."""

from typing import Annotated, Any

from ctid_cli.specification.own_sections import OWN_FORM
from ctid_cli.specification.sections import Kinds, Section

ExcitationSection = Annotated[Section, Kinds("excitation", own=OWN_FORM)]
SamplingSection = Annotated[Section, Kinds("sampling", own=OWN_FORM)]
NoiseSection = Annotated[Section, Kinds("noise", own=OWN_FORM)]
DisturbanceSection = Annotated[Section, Kinds("disturbance")]
EstimatorSection = Annotated[Any, Kinds("estimator", "frequency_estimator", own=OWN_FORM)]
