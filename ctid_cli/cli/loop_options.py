"""Options of ``ctid fit`` for records of a closed loop."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from ctid_cli.cli._options import flag
from ctid_cli.errors import UsageError

if TYPE_CHECKING:
    from ctid_cli.signals.measurement import Measurement

#: What is known of a loop: nothing, its reference as an instrument, or reference and controller.
LoopUse = Literal["none", "reference", "controller"]
#: A loop with an unknown controller.
UNKNOWN = "unknown"
DIRECT = (
    "The model is fitted to the input as it was measured in the loop (direct method): that is right only if the noise "
    "model is (white noise of the output, or that of --noise), if there is a delay of a sample in the loop, and if the "
    "plant is stable or --unstable is given."
)
NO_DELAY = "The delay was taken as 0, because --delay is not given."


def without_delay(measured: Measurement) -> Measurement:
    """Return a measurement with a note that its delay was not given."""
    return replace(measured, notes=(*measured.notes, NO_DELAY))


@dataclass(frozen=True)
class LoopOptions:
    """Loop in which a record was taken."""

    loop: Annotated[
        str | None, flag("--loop", "YAML with the section loop of the record, if it is known.", "FILE|unknown")
    ] = None
    reference: Annotated[str | None, flag("--reference", "Column of the loop's reference.", "NAME")] = None
    direct: Annotated[bool, flag("--direct", "Fit to the input as if there were no loop: noise through it biases.")] = (
        False
    )
    unstable: Annotated[bool, flag("--unstable", "The plant may be unstable, in a loop that is not.")] = False

    @property
    def use(self) -> LoopUse:
        """What is known of the loop."""
        if self.direct or (self.loop in (None, UNKNOWN) and self.reference is None):
            return "none"
        return "reference" if self.loop in (None, UNKNOWN) else "controller"

    @cached_property
    def known(self) -> Any:
        """Loop of the file; None if there is none."""
        if self.loop is None or self.loop == UNKNOWN:
            return None
        from ctid_cli.specification.load import load_loop

        return load_loop(Path(self.loop))

    def check(self) -> None:
        """Refuse incomplete loop options, and a file that contains no loop."""
        if self.direct and self.loop is None:
            raise UsageError(
                "--direct says how a record in a loop is fitted; add --loop FILE or --loop unknown, or drop it"
            )
        if self.unstable and (self.loop != UNKNOWN or self.direct):
            known = "with --loop FILE and --reference COLUMN a plant may be unstable anyway"
            raise UsageError(f"--unstable goes with --loop unknown, without --direct; {known}")
        if self.known is not None and self.reference is None and not self.direct:
            raise UsageError(
                "--loop FILE needs the reference too; add --reference COLUMN, or --direct to fit without it"
            )

    def applied(self, measured: Measurement) -> Measurement:
        """Return a measurement in its loop, or with a note on the needs of the direct method."""
        if self.loop is None and self.reference is None:
            return measured
        from ctid_cli.simulation.record_loop import in_loop, in_unknown_loop

        if self.use == "controller":
            return in_loop(measured, self.known)
        if self.use == "reference":
            return in_unknown_loop(measured)
        return replace(measured, record=replace(measured.record, feedback=True), notes=(*measured.notes, DIRECT))
