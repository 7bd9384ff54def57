"""``ctid track --pmu``: synchrophasors of a mains record."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

from ctid_cli.cli._common import answer, refuse_overwriting, write_files
from ctid_cli.errors import UsageError

if TYPE_CHECKING:
    from ctid_cli.frequency.synchrophasor_filters import PerformanceClass
    from ctid_cli.storage.track_file import Reading


class Mains(NamedTuple):
    """What ``--pmu`` and the options beside it ask for."""

    nominal: int | None
    performance_class: PerformanceClass | None
    reporting_rate: int | None

    def wanted(self, colliding: dict[str, bool]) -> bool:
        """Whether synchrophasors are asked for; refuses what does not go together with them."""
        if self.nominal is None:
            for name, value in (("--pmu-class", self.performance_class), ("--reporting-rate", self.reporting_rate)):
                if value is not None:
                    raise UsageError(f"{name} belongs to synchrophasors; add --pmu 50 or --pmu 60")
            return False
        if self.nominal not in (50, 60):
            raise UsageError(f"--pmu is the nominal frequency of the mains, 50 or 60 Hz, not {self.nominal}")
        given = next((name for name, there in colliding.items() if there), None)
        if given is not None:
            fixed = (
                "the standard fixes tones, windows and instants; --reporting-rate and --pmu-class choose among its own"
            )
            raise UsageError(f"{given} does not go together with --pmu: {fixed}")
        return True


def track_mains(
    file: Path,
    reading: Reading,
    mains: Mains,
    style: Literal["csv", "h5"],
    out: Path,
    as_json: bool,
) -> None:
    """Measure synchrophasors of one signal, or of three that are named with commas between them."""
    import numpy as np

    from ctid_cli.frequency.synchrophasor import measure_synchrophasors
    from ctid_cli.reporting import synchrophasor_report as report
    from ctid_cli.reporting.synchrophasor_plot import synchrophasor_drawing

    data, figure = out / f"synchrophasors.{style}", out / "synchrophasors.svg"
    refuse_overwriting([file], [data, figure])
    names = [None if reading.signal is None else name.strip() for name in (reading.signal or "").split(",")]
    if len(names) not in (1, 3):
        raise UsageError(f"--signal names {len(names)} signals; synchrophasors are those of one or of three phases")
    if len(set(names)) < len(names):
        raise UsageError(f"--signal {reading.signal} names one signal twice; three phases are three signals")
    signals = [replace(reading, signal=name).read(file) for name in names]
    first = signals[0]
    try:
        found = measure_synchrophasors(
            np.column_stack([each.samples for each in signals]),
            first.interval,
            start=first.start,
            nominal=mains.nominal or 0,
            performance_class=mains.performance_class or "P",
            reporting_rate=mains.reporting_rate,
        )
    except ValueError as error:
        raise UsageError(str(error)) from None
    title = f"{file.name}: synchrophasors, class {found.performance_class}"
    drawn = synchrophasor_drawing(found, first.unit, title).saved()
    write_files({data: report.synchrophasor_bytes(found, style, first.unit), figure: drawn})
    answer(
        as_json,
        lambda: report.synchrophasor_object(signals, found),
        lambda: report.synchrophasor_text(signals, found),
        [data, figure],
    )
