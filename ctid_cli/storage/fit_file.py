"""``fit.json``: lossless storage of a fit and the paths of its records, and reading it again.

The file has the numbers for people and programs, as printed by ``ctid fit --json``, and ``result``, the fit as in
Python. Arrays with one value per sample are not stored; they are computed from the records when first used.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, get_args

import numpy as np

from ctid_cli.errors import UsageError
from ctid_cli.estimators.identification import Identification, laid_out_validation
from ctid_cli.inference.robust_loss import Weighting
from ctid_cli.inference.units import Units
from ctid_cli.models.controller import ContinuousController, DiscreteController
from ctid_cli.signals.held import Hold
from ctid_cli.signals.measurement import Measurement, read_measurement
from ctid_cli.signals.record import Loop, Record
from ctid_cli.signals.table import ROLES
from ctid_cli.storage.result_file import ResultKind, Source, decoded, encoded, path_and_sum, require, texts

#: Format 2 adds the formula of the standard errors and the bounds of the admissible models.
FIT = ResultKind("ctid fit", 2, "fit", "ctid fit", "fit again", oldest=2)
#: A path as given by the caller.
AnyPath = str | os.PathLike[str]


# --- writing ---------------------------------------------------------------------------------------


def fit_text(
    result: Identification,
    content: Mapping[str, Any],
    measurements: Sequence[Measurement],
    validation: Measurement | None,
    folder: Path,
    command: str | None = None,
) -> str:
    """Return the text of the file: the description of a fit, the fit, and its records relative to the file's folder."""
    whole = dict(content)
    whole["records"] = [
        {**said, **_source(item, folder)} for said, item in zip(content["records"], measurements, strict=True)
    ]
    if validation is not None:
        whole["validation"] = {**content["validation"], **_source(validation, folder)}
    whole["result"] = encoded(result)
    return FIT.text(whole, command)


def _source(measurement: Measurement, folder: Path) -> dict[str, Any]:
    """Return the path of a record and how it was read, or its samples if it is not a file."""
    if measurement.path is None:
        return {"path": None, "series": encoded(measurement.record)}
    return {
        **path_and_sum(measurement.path, folder),
        "columns": {"time": measurement.time, "input": measurement.columns, "output": measurement.output},
        "hold": measurement.record.hold,
        "from": measurement.start,
        "to": measurement.stop,
        **_loop(measurement),
    }


def _loop(measurement: Measurement) -> dict[str, Any]:
    """Return the loop of a record, if known."""
    loop = measurement.record.loop
    if loop is None:
        return {}
    if loop.controller is None:
        return {"loop": {"reference": measurement.reference}}
    sides = {name: np.asarray(getattr(loop.controller, name)).tolist() for name in ("numerator", "denominator")}
    kind = {"continuous": loop.continuous, "hold": loop.hold}
    return {"loop": {"reference": measurement.reference, "enters": loop.enters, **kind, **sides}}


# --- reading ---------------------------------------------------------------------------------------


class RecordSource(Source):
    """A record as ``fit.json`` names it."""

    def read(self) -> Measurement:
        """Return the record as it was read for the fit."""
        content = self.content
        if content["path"] is None:
            series = dict(content["series"])
            if "input" in series:
                # Older files have one input only.
                series["inputs"] = series.pop("input")
            return Measurement.of(decoded(series, Record, "series"))
        self.require_same()
        columns = {role: content["columns"][role] for role in ("time", "input", "output")}
        window = {"start": content["from"], "stop": content["to"]}
        loop = content.get("loop")
        reference = None if loop is None else loop["reference"]
        found = read_measurement(self.place, **columns, hold=content["hold"], **window, reference=reference)
        if loop is not None and found.reference_values is not None:
            closed = Loop(found.reference_values, None)
            if "numerator" in loop:
                kind = ContinuousController if loop.get("continuous") else DiscreteController
                controller = kind(loop["numerator"], loop["denominator"])
                closed = Loop(found.reference_values, controller, loop["enters"], loop.get("hold", "zoh"))
            found = replace(found, record=replace(found.record, loop=closed))
        return replace(found, record=replace(found.record, name=self.name))


@dataclass(frozen=True, eq=False)
class StoredFit:
    """A ``fit.json``, with the records that it names."""

    path: Path
    #: Content of the file, as in the documentation of machine-readable output.
    content: Mapping[str, Any]
    result: Identification
    sources: tuple[RecordSource, ...]
    validation_source: RecordSource | None

    @property
    def units(self) -> Units:
        """Units of the records."""
        return Units(**self.content["units"])

    @cached_property
    def measurements(self) -> tuple[Measurement, ...]:
        """The records that the fit was estimated from."""
        return tuple(source.read() for source in self.sources)

    @cached_property
    def validation(self) -> Measurement | None:
        """The validation record."""
        return None if self.validation_source is None else self.validation_source.read()

    # Deferred fields are filled by methods, which can be pickled with their objects.

    def _records(self) -> dict[str, Any]:
        return {"records": tuple(item.record for item in self.measurements)}

    def _samples(self) -> dict[str, Any]:
        fit, options = self.result.fit, self.result.options
        return options._samples(fit, options.prepare(self.result.records).laid_out)._asdict()

    def _weights(self) -> dict[str, Any]:
        weighting = self._samples()["weighting"]
        return {name: getattr(weighting, name) for name in Weighting.deferred}

    def _applied(self) -> dict[str, Any]:
        assert self.validation is not None
        fit, record = self.result.fit, self.validation.record
        own = self.result.validation
        options = self.result.options if own is None or own.options is None else own.options
        laid_out = laid_out_validation(options, record)
        return {"record": record, "applied": options._applied(fit, laid_out)}


def load_fit(
    path: AnyPath, record: AnyPath | Sequence[AnyPath] | None = None, validation: AnyPath | None = None
) -> Identification:
    """Read a fit that ``ctid fit`` or :func:`~ctid_cli.reporting.fit_result.save_fit` wrote.

    Parameters
    ----------
    path : path
        The file, such as ``fit.json``.
    record : path or sequence of path, optional
        New paths of the records of the fit, in their order, if they moved.
    validation : path, optional
        New path of the validation record, if it moved.

    Returns
    -------
    Identification
        What :func:`~ctid_cli.estimators.identification.identify` returned, equal in all numbers. Residuals,
        sensitivities and records are computed again or read when first used.

    Raises
    ------
    DataError
        If the file is damaged, from a newer ctid, or not a fit; or, when records are needed, if they are missing or
        differ from those of the fit.

    Examples
    --------
    >>> import numpy as np, tempfile
    >>> from ctid_cli import DelayProfile, Record, identify, load_fit, save_fit
    >>> t = 0.1 * np.arange(200)
    >>> record = Record.from_arrays(t, np.sign(np.sin(t)), np.sin(t) + 0.1 * np.cos(9 * t))
    >>> fit = identify([record], DelayProfile(poles=1, zeros=0, delay_bounds=(0, 2)))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     save_fit(fit, f"{folder}/fit.json")
    ...     again = load_fit(f"{folder}/fit.json")
    >>> again.fit.theta.tolist() == fit.fit.theta.tolist()
    True
    """
    return read_fit(path, record, validation).result


def read_fit(
    path: AnyPath, record: AnyPath | Sequence[AnyPath] | None = None, validation: AnyPath | None = None
) -> StoredFit:
    """Return the file with all its content; see :func:`load_fit`."""
    file = os.fspath(path)
    content = FIT.content(file)
    moved = [] if record is None else [record] if isinstance(record, str | os.PathLike) else list(record)
    with FIT.refusing(file):
        result = decoded(content["result"], Identification)
        listed, validated = content["records"], content["validation"]
        _require_sources(content)
        if moved and len(moved) != len(listed):
            raise UsageError(f"{file} is of {len(listed)} records; --record names {len(moved)}")
        places = [os.fspath(each) for each in moved] if moved else [None] * len(listed)
        sources = tuple(RecordSource(FIT, file, each, place) for each, place in zip(listed, places, strict=True))
        other = validated and RecordSource(FIT, file, validated, None if validation is None else os.fspath(validation))
    if validation is not None and other is None:
        raise UsageError(f"{file} has no validation record; leave --validate out")
    for source in (*sources, *([other] if other else [])):
        if source.moved is not None:
            source.require_same()
    stored = StoredFit(Path(file), content, result, sources, other)
    result.leave_out(stored._records)
    result.fit.leave_out(stored._samples)
    if result.fit.weighting is not None:
        result.fit.weighting.leave_out(stored._weights)
    if result.validation is not None:
        result.validation.leave_out(stored._applied)
    return stored


def read_fits(files: Sequence[Path]) -> list[StoredFit]:
    """Return several files; all must have the same units."""
    found = [read_fit(file) for file in files]
    for fit in found:
        found[0].units.require_same(fit.path.name, asdict(fit.units), "the models are")
    return found


def _require_sources(content: Mapping[str, Any]) -> None:
    """Refuse a file without the information needed to read its records."""
    require("units", list(content["units"]) == ["time", "input", "output"] and texts(content["units"].values()))
    require("command", content["command"] is None or isinstance(content["command"], str))
    for each in (*content["records"], *([content["validation"]] if content["validation"] else [])):
        require("file", "file" in each)
        if each["path"] is not None:
            require("path", texts([each["path"], each["sha256"]]))
            require("columns", texts(each["columns"][role] for role in ROLES if role != "input"))
            inputs = each["columns"]["input"]
            require("columns", isinstance(inputs, str) or (isinstance(inputs, list) and texts(inputs)))
            holds = each["hold"] if isinstance(each["hold"], list) else [each["hold"]]
            require("hold", bool(holds) and all(hold in get_args(Hold) for hold in holds))
            ends = [each[word] for word in ("from", "to")]
            require("from and to", all(end is None or isinstance(end, int | float) for end in ends))
