"""``ctid fit`` and ``ctid order`` on a frequency response."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ctid_cli.cli._options import RecordOptions, given_options, refuse_options
from ctid_cli.cli.fit_structure import FRACTION, SUM, ModelRequest, as_usage_errors
from ctid_cli.errors import UsageError

if TYPE_CHECKING:
    from ctid_cli.identification.choice import Given
    from ctid_cli.reporting.frequency_fit import FrequencyFitResult
    from ctid_cli.reporting.response_order import ResponseOrder
    from ctid_cli.signals.frequency_data import FrequencyData
    from ctid_cli.signals.treatment import Weight

#: Options that apply only to records, and why.
AT_REST = "its system is at rest"
IN_LOOP = "a response that was measured in a loop is taken as it is"
COLUMNS = "its columns are found by their names"
OF_RECORDS = {
    "--initial-state": AT_REST,
    "--input-before": AT_REST,
    "--offset": "an offset is a line at frequency 0; leave that line out",
    "--loss": "lines are fitted by weighted squares",
    "--noise": "lines have weights, and no noise model over time",
    "--hold": "the file states it, in a comment '# hold: zoh'",
    "--loop": IN_LOOP,
    "--reference": IN_LOOP,
    "--direct": IN_LOOP,
    "--time": COLUMNS,
    "--input": f"{COLUMNS}; several inputs are fitted from records",
    "--output": COLUMNS,
    "--validate": "compare the responses of two fits, or give a record to ctid compare",
    "--bootstrap": "its standard errors are from those of the lines",
    "--predict": "there is nothing to predict",
}


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
    files: Sequence[Path], request: ModelRequest, columns: RecordOptions, assessment: object
) -> FrequencyFitResult:
    """Fit a model to the given frequency response; a UsageError for options that do not apply to one."""
    from ctid_cli.estimators.frequency_domain import FrequencyDomain, FrequencyDomainSum
    from ctid_cli.identification.choice import Given
    from ctid_cli.identification.identify_response import identify_frequency_response
    from ctid_cli.reporting.frequency_fit import FrequencyFitResult

    given = given_options(request.options, request.loop, columns, assessment)
    refuse_options(given, OF_RECORDS, _kind(files))
    kind = "a sum of submodels" if request.is_sum else "one transfer function"
    refuse_options(given, SUM if request.is_sum else FRACTION, kind)
    options = request.options.with_delays()
    poles, zeros, integrators = (options.common(name) for name in ("poles", "zeros", "integrators"))
    if request.is_sum and options.terms is None:
        raise UsageError("--terms is missing: for a frequency response it must be given")
    if needing := [
        name for name, own in {"--fix": options.fix, "--bound": options.bound}.items() if own and poles is None
    ]:
        raise UsageError(f"{'--terms' if request.is_sum else '--poles'} is missing: with {needing[0]} it must be given")
    data = _read(files, options.weight, columns)
    with as_usage_errors():
        delays: Any = options.common("delay_bounds") or (0.0, 0.0)
        estimator: FrequencyDomain | FrequencyDomainSum | Given
        if not request.is_sum and (poles is None or isinstance(poles, tuple) or isinstance(zeros, tuple)):
            estimator = Given(poles, zeros, integrators, options.common("delay_bounds"))
        elif request.is_sum:
            estimator = FrequencyDomainSum(options.submodels, delays, fixed=options.fixed)
        else:
            known: Any = {"integrators": integrators or 0, "fixed": options.fixed, "bounds": options.bounds}
            estimator = FrequencyDomain(poles, zeros or 0, delays, **known)
        return FrequencyFitResult.of(identify_frequency_response(data, estimator))


def frequency_order(
    files: Sequence[Path],
    requested: Callable[[], Given],
    weight: Weight | None,
    columns: RecordOptions,
    given: list[str],
) -> ResponseOrder:
    """Choose a structure for the given frequency response; a UsageError for options that do not apply to one."""
    from ctid_cli.identification.choose_response import choose_response
    from ctid_cli.reporting.response_order import ResponseOrder

    refused = OF_RECORDS | {"--model": "give the submodels to ctid fit --terms; drop it", "--modes": "drop it"}
    refuse_options([*given, *given_options(columns)], refused, _kind(files))
    with as_usage_errors():
        return ResponseOrder(choose_response(_read(files, weight, columns), requested()))


def _kind(files: Sequence[Path]) -> str:
    """Return what a file is; a UsageError if there are several."""
    if len(files) > 1:
        raise UsageError(f"{len(files)} files are given, and a frequency response is fitted by itself; give one file")
    return f"a frequency response ({files[0]})"


def _read(files: Sequence[Path], weight: Weight | None, columns: RecordOptions) -> FrequencyData:
    """Return the frequency response in the given band, with its weights."""
    from ctid_cli.signals.frequency_data import read_frequency_data

    data = read_frequency_data(files[0], columns.start, columns.stop)
    if weight is not None and data.standard_error is not None:
        raise UsageError(
            f"--weight is for lines without standard errors, and {files[0]} has them; drop --weight, or rename the "
            "column standard_error"
        )
    return replace(data, weight=weight or "none")
