"""Options that several commands share, each written once.

A parameter of a command whose type is a dataclass stands for the options that its fields are.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from ctid_cli.errors import UsageError
from ctid_cli.reporting.document import Format

if TYPE_CHECKING:
    from ctid_cli.signals.measurement import Measurement


def with_option_groups(command: Callable[..., None]) -> Callable[..., None]:
    """Replace each dataclass among the parameters of a command by the options that its fields are."""
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
            # Who calls a command from Python may give the whole group.
            if not isinstance(given.get(name), group):
                known = {option.name for option in fields(group)} & given.keys()
                given[name] = group(**{option: given.pop(option) for option in known})
        command(*values, **given)

    as_options = [each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in parameters]
    wrapper.__signature__ = inspect.Signature(as_options)  # type: ignore[attr-defined]
    wrapper.__annotations__ = {each.name: each.annotation for each in as_options}
    return wrapper


TimeColumn = Annotated[str | None, typer.Option("--time", metavar="NAME", help="Column of the times.")]
From = Annotated[float | None, typer.Option("--from", metavar="TIME", help="First instant to use [unit of the file].")]
To = Annotated[float | None, typer.Option("--to", metavar="TIME", help="Last instant to use.")]


@dataclass(frozen=True)
class RecordOptions:
    """Which columns and which part of measured records are used."""

    time: TimeColumn = None
    input: Annotated[
        list[str] | None, typer.Option("--input", metavar="NAME", help="Column of the input; repeatable.")
    ] = None
    output: Annotated[list[str] | None, typer.Option("--output", metavar="NAME", help="Column of the output.")] = None
    start: From = None
    stop: To = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of several inputs, else none."""
        from ctid_cli.signals.measurement import input_name

        several = self.input if self.input and len(self.input) > 1 else ()
        return tuple(input_name(name) for name in several)

    def read(self, file: Path, hold: Any, **others: Any) -> Measurement:
        """Read a record, between the instants that are given."""
        return self.read_whole(file, hold, start=self.start, stop=self.stop, **others)

    def read_whole(self, file: Path, hold: Any, **others: Any) -> Measurement:
        """Read a record from its beginning to its end, such as one for validation."""
        from ctid_cli.signals.measurement import read_measurement

        if self.output and len(self.output) > 1:
            raise UsageError(
                f"--output is given {len(self.output)} times, and models have one output: fit one --output at a time"
            )
        output = self.output[0] if self.output else None
        return read_measurement(file, time=self.time, input=self.input or None, output=output, hold=hold, **others)


@dataclass(frozen=True)
class FormatOptions:
    """The form of what a command prints."""

    format: Annotated[Format, typer.Option("--format", help="Output format.")] = "text"
    json: Annotated[bool, typer.Option("--json", help="Short for --format json.")] = False

    @property
    def form(self) -> Format:
        """The form that is asked for."""
        return "json" if self.json else self.format
