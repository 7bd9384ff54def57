"""Sections whose ``kind`` selects an option dataclass of the floors below."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field

from ctid_cli.specification.fields import matching
from ctid_cli.specification.sections import Kinds, Section

#: A content hash that may be missing.
Sha256 = Annotated[str, matching("[0-9a-f]{64}", "a SHA-256 is 64 hexadecimal digits in lower case")] | None
SHA256 = Field(
    default=None,
    description="SHA-256 of the file, to make sure of its content; filled in from the file if it is missing",
)

ExcitationSection = Annotated[Section, Kinds("excitation", file={"sha256": (Sha256, SHA256)})]
SamplingSection = Annotated[Section, Kinds("sampling")]
NoiseSection = Annotated[Section, Kinds("noise")]
DisturbanceSection = Annotated[Section, Kinds("disturbance")]
EstimatorSection = Annotated[Any, Kinds("estimator", "frequency_estimator")]
