"""Sections whose ``kind`` selects an option dataclass of the floors below."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from ctid_cli.specification.fields import matching
from ctid_cli.specification.sections import Section, kind_section

#: A content hash that may be missing.
Sha256 = Annotated[str, matching("[0-9a-f]{64}", "a SHA-256 is 64 hexadecimal digits in lower case")] | None
SHA256 = Field(
    default=None,
    description="SHA-256 of the file, to make sure of its content; filled in from the file if it is missing",
)

if TYPE_CHECKING:
    ExcitationSection = Section
    SamplingSection = Section
    NoiseSection = Section
    DisturbanceSection = Section

    class EstimatorSection(Section):
        """The options of an estimator."""

        kind: str
else:
    ExcitationSection = kind_section("excitation", {"file": {"sha256": (Sha256, SHA256)}})
    SamplingSection = kind_section("sampling")
    NoiseSection = kind_section("noise")
    DisturbanceSection = kind_section("disturbance")
    EstimatorSection = kind_section("estimator frequency_estimator")
