"""The section ``limits`` of a specification: what one estimate may take of the machine."""

from collections.abc import Iterator

from ctid_cli.specification.fields import Positive
from ctid_cli.specification.messages import Complaint
from ctid_cli.specification.sections import Section


class LimitsSection(Section):
    """What one estimate may take; what takes more is ended and counts as a failure of its estimator.

    Parameters
    ----------
    cpu_seconds : float, optional
        Most processor time of an estimate [s]; no limit by default
    wall_seconds : float, optional
        Most time of an estimate, asleep or at work [s]; no limit by default
    memory_mb : float, optional
        Most memory of an estimate beyond what its process held before [MB]; no limit by default
    """

    cpu_seconds: Positive | None = None
    wall_seconds: Positive | None = None
    memory_mb: Positive | None = None

    def complaints(self) -> Iterator[Complaint]:
        """Say that nothing is limited."""
        if all(getattr(self, name) is None for name in type(self).model_fields):
            yield (), "give cpu_seconds, wall_seconds, memory_mb or several of them; for example {wall_seconds: 600}"
