"""Options that several commands share.

A parameter of a command whose type is a dataclass stands for one option for each of its fields.
"""

from __future__ import annotations

import contextlib
import functools
import inspect
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from ctid_cli.errors import UsageError
from ctid_cli.reporting.document import Format

if TYPE_CHECKING:
    from ctid_cli.reporting.records import Records as MeasuredRecords
    from ctid_cli.signals.measurement import Measurement


def with_option_groups(command: Callable[..., None]) -> Callable[..., None]:
    """Replace each dataclass among the parameters of a command by options for its fields."""
    signature = inspect.signature(command, eval_str=True)
    groups: dict[str, Any] = {
        name: each.annotation for name, each in signature.parameters.items() if is_dataclass(each.annotation)
    }
    parameters: list[inspect.Parameter] = []
    for name, parameter in signature.parameters.items():
        if name not in groups:
            parameters.append(parameter)
            continue
        types = get_type_hints(groups[name], include_extras=True)
        for option in fields(groups[name]):
            kind = inspect.Parameter.KEYWORD_ONLY
            parameters.append(
                inspect.Parameter(option.name, kind, default=option.default, annotation=types[option.name])
            )

    @functools.wraps(command)
    def wrapper(*values: Any, **given: Any) -> None:
        for name, group in groups.items():
            # A caller from Python may pass the whole group.
            if not isinstance(given.get(name), group):
                known = {option.name for option in fields(group)} & given.keys()
                given[name] = group(**{option: given.pop(option) for option in known})
        command(*values, **given)

    as_options = [each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in parameters]
    wrapper.__signature__ = inspect.Signature(as_options)  # type: ignore[attr-defined]
    wrapper.__annotations__ = {each.name: each.annotation for each in as_options}
    return wrapper


def flag(name: str, help: str, metavar: str | None = None, **more: Any) -> Any:
    """Return the declaration of an option."""
    return typer.Option(name, help=help, metavar=metavar, **more)


def given_options(*groups: Any) -> list[str]:
    """Return the names of the options of some groups that differ from their defaults."""
    found = []
    for group in groups:
        types = get_type_hints(type(group), include_extras=True)
        given = [option.name for option in fields(group) if getattr(group, option.name) != option.default]
        # Typer takes the first argument of an annotated option, its name, as the default.
        found += [types[name].__metadata__[0].default for name in given]
    return found


def refuse_options(given: Iterable[str], remedies: Mapping[str, str], purpose: str) -> None:
    """Refuse the first given option that is not available for a purpose, with the remedy."""
    for option in given:
        if option in remedies:
            raise UsageError(f"{option} is not available for {purpose}; {remedies[option]}")


def finite(text: str) -> float:
    """Return a finite number."""
    with contextlib.suppress(ValueError):
        if math.isfinite(float(text)):
            return float(text)
    raise typer.BadParameter(f"must be a finite number, not {text!r}")


def positive(text: str) -> float:
    """Return a positive number whose reciprocal is finite too."""
    value = finite(text)
    if not (value > 0 and math.isfinite(1.0 / value)):
        raise typer.BadParameter(f"must be a positive number, not {text!r}")
    return value


TimeColumn = Annotated[str | None, flag("--time", "Column of the times.", "NAME")]
From = Annotated[float | None, flag("--from", "First instant to use [unit of the file].", "TIME", parser=finite)]
To = Annotated[float | None, flag("--to", "Last instant to use.", "TIME", parser=finite)]
Records = Annotated[
    list[Path], typer.Argument(metavar="FILE...", help="Records (.csv, .mat, .h5), an experiment each.")
]
Validate = Annotated[Path | None, flag("--validate", "Validate on this record too.", "FILE")]


@dataclass(frozen=True)
class RecordOptions:
    """Columns and part of measured records to use."""

    time: TimeColumn = None
    input: Annotated[list[str] | None, flag("--input", "Column of the input; repeatable.", "NAME")] = None
    output: Annotated[list[str] | None, flag("--output", "Column of the output.", "NAME")] = None
    start: From = None
    stop: To = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of several inputs, else none."""
        from ctid_cli.signals.table import split_header

        several = self.input if self.input and len(self.input) > 1 else ()
        return tuple(split_header(name)[0] for name in several)

    def read(self, file: Path, hold: Any, **others: Any) -> Measurement:
        """Read a record between the given instants."""
        return self._read(file, hold, start=self.start, stop=self.stop, **others)

    def _read(self, file: Path, hold: Any, **others: Any) -> Measurement:
        from ctid_cli.signals.measurement import read_measurement

        if self.output and len(self.output) > 1:
            raise UsageError(
                f"--output is given {len(self.output)} times, and models have one output: fit one --output at a time"
            )
        output = self.output[0] if self.output else None
        return read_measurement(file, time=self.time, input=self.input or None, output=output, hold=hold, **others)

    def read_all(self, files: Sequence[Path], validate: Path | None, hold: Any, **others: Any) -> MeasuredRecords:
        """Read records, and a whole one for validation; a DataError if their units differ."""
        from ctid_cli.reporting.records import Records

        other = None if validate is None else self._read(validate, hold, **others)
        records = Records([self.read(file, hold, **others) for file in files], other)
        # Different units are refused before anything is computed.
        records.units  # noqa: B018
        return records


@dataclass(frozen=True)
class FormatOptions:
    """Form of a command's output."""

    format: Annotated[Format, flag("--format", "text, json, md, csv, html or latex.", "FORMAT")] = "text"
    json: Annotated[bool, flag("--json", "Short for --format json.")] = False

    @property
    def form(self) -> Format:
        """Requested form."""
        return "json" if self.json else self.format
