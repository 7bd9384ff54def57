"""Sections whose ``kind`` selects an option dataclass of the floors below."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

from ctid_cli.kinds import classes
from ctid_cli.signals.excitation import InputFile
from ctid_cli.specification.sections import Check, Section, by_kind, checked, optional, plain_text, section_for

#: Check of a content hash that may be missing.
SHA256 = optional(plain_text("[0-9a-f]{64}", "a SHA-256 is 64 hexadecimal digits in lower case"))
SHA256_DOC = "SHA-256 of the file, to make sure of its content; filled in from the file if it is missing"


def _kinds(options: Mapping[str, type]) -> dict[str, type[Section]]:
    pin = {"sha256": (Annotated[str | None, checked(SHA256)], Field(default=None, description=SHA256_DOC))}
    return {
        kind: section_for(target, kind=kind, extra=pin if target is InputFile else None)
        for kind, target in options.items()
    }


if TYPE_CHECKING:
    ExcitationSection = Section
    SamplingSection = Section
    NoiseSection = Section
    EstimatorSection = Section
else:
    ExcitationSection = by_kind(_kinds(classes("excitation")))
    SamplingSection = by_kind(_kinds(classes("sampling")))
    NoiseSection = by_kind(_kinds(classes("noise")))
    EstimatorSection = by_kind(_kinds(classes("estimator") | classes("frequency_estimator")))


def check_of(annotation: Any) -> Check:
    """The check inside an annotation such as those of this module."""
    from pydantic import TypeAdapter

    return TypeAdapter(annotation).validate_python
