"""``ctid fit`` on a frequency response."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ctid_cli.cli._options import RecordOptions
from ctid_cli.cli.fit_structure import Asked, LoopOptions, as_usage_errors, check_integrators, with_delays
from ctid_cli.errors import UsageError

if TYPE_CHECKING:
    from ctid_cli.reporting.frequency_fit import FrequencyFitResult


def frequency_files(files: Sequence[Path]) -> list[Path]:
    """Return the files that are tables of frequency responses; errors in others are reported when they are read."""
    from ctid_cli.errors import DataError
    from ctid_cli.signals.frequency_data import is_frequency_table

    found = []
    for file in files:
        try:
            found += [file] if is_frequency_table(file) else []
        except DataError:
            continue
    return found


def frequency_fit(
    files: Sequence[Path], asked: Asked, loop: LoopOptions, columns: RecordOptions, others: dict[str, object]
) -> FrequencyFitResult:
    """Fit a model to the given frequency response; a UsageError for options that do not apply to one."""
    from ctid_cli.estimators.frequency_domain import FrequencyDomain
    from ctid_cli.identification.identify_response import identify_frequency_response
    from ctid_cli.reporting.frequency_fit import FrequencyFitResult
    from ctid_cli.signals.frequency_data import read_frequency_data

    model = asked.model
    if len(files) > 1:
        raise UsageError(f"{len(files)} files are given, and a frequency response is fitted by itself; give one file")
    for name, reason in _of_records(asked, loop, columns, others):
        raise UsageError(f"{name} is for records in time, not for a frequency response ({files[0]}): {reason}")
    if model.model == "additive" or model.terms is not None:
        raise UsageError(
            "--model additive is not available for a frequency response; a sum is the transfer function with all its "
            "poles: give --poles and --zeros"
        )
    if model.poles is None:
        raise UsageError("--poles is missing: for a frequency response it must be given")
    check_integrators(model.integrators or 0, "none")
    data, weight = read_frequency_data(files[0], columns.start, columns.stop), asked.treatment.weight
    if weight is not None and data.standard_error is not None:
        raise UsageError(
            f"--weight is for lines without standard errors, and {files[0]} has them; drop --weight, or rename the "
            "column standard_error"
        )
    data = replace(data, weight=weight or "none")
    delays = with_delays(model, ())
    with as_usage_errors():
        given: Any = {"integrators": model.integrators or 0, "fixed": model.fixed, "bounds": delays.parameter_bounds}
        options = FrequencyDomain(model.poles, model.zeros or 0, delays.bounds or (0.0, 0.0), **given)
        return FrequencyFitResult.of(identify_frequency_response(data, options))


def _of_records(
    asked: Asked, loop: LoopOptions, columns: RecordOptions, others: dict[str, object]
) -> Iterator[tuple[str, str]]:
    """Yield options that apply only to records, and why."""
    treatment = asked.treatment
    rest, noise = "its system is at rest", "lines have weights, and no noise model over time"
    options = {
        "--initial-state": (treatment.initial_state, rest),
        "--input-before": (treatment.input_before, rest),
        "--offset": (treatment.offset, "an offset is a line at frequency 0; leave that line out"),
        "--loss": (treatment.loss, "lines are fitted by weighted squares"),
        "--noise": (treatment.noise != "white" or None, noise),
        "--hold": (treatment.each_hold, "the file says it, in a comment '# hold: zoh'"),
        "--loop": (loop.loop, "a response that was measured in a loop is taken as it is"),
        "--reference": (loop.reference, "a response that was measured in a loop is taken as it is"),
        "--direct": (loop.direct or None, "a response that was measured in a loop is taken as it is"),
        "--time": (columns.time, "its columns are found by their names"),
        "--input": (columns.input, "its columns are found by their names; several inputs are fitted from records"),
        "--output": (columns.output, "its columns are found by their names"),
        "--validate": (others["validate"], "compare the responses of two fits, or give a record to ctid compare"),
        "--bootstrap": (others["bootstrap"], "its standard errors are from those of the lines"),
        "--predict": (others["predict"], "there is nothing to predict"),
    }
    yield from ((name, reason) for name, (value, reason) in options.items() if value is not None)
