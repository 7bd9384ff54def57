"""Common parts of all commands: the results option, and reporting of errors."""

import contextlib
import errno
import functools
import itertools
import json
import os
import re
import shlex
import shutil
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NoReturn, TypeVar, cast

import typer
from typer.core import TyperArgument, TyperCommand

from ctid_cli.canonical import plain
from ctid_cli.cli._options import flag, with_option_groups
from ctid_cli.cli._progress import Watch, interruptible
from ctid_cli.errors import CtidError, ExitCode, RefusedError, SpecError, StorageError, UsageError
from ctid_cli.progress import reported
from ctid_cli.reporting.document import Format, Result
from ctid_cli.written_files import write_file

Function = TypeVar("Function", bound=Callable[..., None])
Number = TypeVar("Number", int, float)

Out = Annotated[Path, flag("--out", "Folder that holds the results.", "DIR")]
Overrides = Annotated[
    list[str] | None, flag("--set", "Replace one value of the file, e.g. noise.snr_db=15; repeatable.", "KEY=VALUE")
]
AllowCode = Annotated[
    bool, flag("--allow-code", "Run the code that the file names as kind; trust it.", envvar="CTID_ALLOW_CODE")
]
AllowOutside = Annotated[
    bool, flag("--allow-outside", "Read data files outside the folder of the file.", envvar="CTID_ALLOW_OUTSIDE")
]
Jobs = Annotated[
    int | None,
    typer.Option("--jobs", "-j", min=1, metavar="N", help="Worker processes; all processors by default."),
]
Runs = Annotated[int | None, flag("--runs", "Number of data sets per setting, in place of the file's.", "N", min=1)]
AllowMixed = Annotated[bool, flag("--allow-mixed", "Mix code versions or processors.")]
Fresh = Annotated[bool, flag("--fresh", "Move older results aside and start anew.")]
Config = Annotated[Path, typer.Argument(metavar="CONFIG", help="Experiment file (YAML).")]
Configs = Annotated[list[Path], typer.Argument(metavar="CONFIG", help="Experiment files (YAML).")]

#: Options on where and in what form results are written, which do not change their content.
_OF_OUTPUT = ("format", "json", "out", "report", "csv", "export")
#: Errors of the disk: full, over quota, read-only, or failing.
_OF_THE_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO, errno.EFBIG)


class Command(TyperCommand):
    """A command that shows its progress, and refuses an option given twice, as only its last value would count."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the help of arguments and options; the names of arguments say what they are, without a type."""
        for parameter in self.params:
            if isinstance(parameter, TyperArgument):
                parameter.display_type_rich = lambda ctx: ""  # type: ignore[method-assign]
        super().format_options(ctx, formatter)

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the command line."""
        _, _, given = self.make_parser(ctx).parse_args(args=list(args))
        for option in given:
            if option.param_type_name == "option" and not option.multiple and given.count(option) > 1:
                ctx.fail(f"{max(option.opts, key=len)} is given twice.")
        try:
            return super().parse_args(ctx, args)
        except typer.BadParameter as error:
            said = error.message.removeprefix("Value error, ")
            error.message = said.replace("Input should be greater than or equal to", "must be at least")
            raise

    def invoke(self, ctx: Any) -> Any:
        """Run the command, show what it does if it takes long, and end it after Ctrl-C."""
        with Watch(str(ctx.info_name), quiet=bool(ctx.params.get("quiet"))):
            return super().invoke(ctx)


def duration(text: str) -> float:
    """Return a time such as ``90s``, ``30m`` or ``1h30m`` in seconds."""
    found = re.fullmatch(r"(?:(\d+)h)?(?:(\d+)m)?(?:(\d+)s)?", text.strip())
    parts = [float(part or 0) for part in found.groups()] if found else []
    if not any(parts):
        raise typer.BadParameter(f"{text!r} is no time; write for example 90s, 30m or 1h30m")
    hours, minutes, rest = parts
    return 3600 * hours + 60 * minutes + rest


def given_command(context: typer.Context) -> str:
    """Return the command that runs, with the options that differ from their defaults, except those of outputs."""
    words = context.command_path.split()
    for option in context.command.params:
        value = context.params.get(str(option.name))
        if value == option.get_default(context) or option.name in _OF_OUTPUT:
            continue
        name = [max(option.opts, key=len)] if option.param_type_name == "option" else []
        for each in value if isinstance(value, list | tuple) else [value]:
            words += name if each is True else [*name, str(each)]
    return shlex.join(words)


def span(text: str, number: Callable[[str], Number]) -> tuple[Number, Number] | None:
    """Return the ends of ``LOW:HIGH``, or one value twice; None for anything else."""
    low, colon, high = text.partition(":")
    try:
        return number(low), number(high if colon else low)
    except ValueError:
        return None


@reported("writing the result")
def emit(
    result: Result,
    form: Format,
    written: Sequence[Path] = (),
    stored: str | None = None,
    draw: Callable[[], None] = lambda: None,
) -> None:
    """Print a result in the requested form, JSON as it was stored; then draw its figures, and name the files."""
    names = list(map(str, written))
    try:
        _print(result, form, names, stored)
        if Watch.current is not None:
            Watch.current.display.postpone()
    finally:
        # A reader that closes the pipe, such as head, does not lose the figures.
        draw()
    if names and form == "text":
        typer.echo(f"\nWritten: {', '.join(names)}")


def _print(result: Result, form: Format, names: Sequence[str], stored: str | None) -> None:
    if form == "json":
        if stored is None:
            content = result.json_content()
            stored = json.dumps(plain({**content, "written": names} if names else content), allow_nan=False)
        typer.echo(stored.rstrip("\n"))
        return
    # Text is wrapped to a terminal, but is the same everywhere in a pipe or a file.
    columns = shutil.get_terminal_size().columns if sys.stdout.isatty() else None
    typer.echo(result.write(form, columns))


def refuse_overwriting(inputs: Iterable[Path], written: Sequence[Path]) -> None:
    """Refuse, before anything is computed, to overwrite an input, or to write below a file."""
    for folder in {folder for path in written for folder in path.parents if folder.is_file()}:
        raise StorageError(f"{folder} is a file, not a folder to write in")
    for file, path in itertools.product(inputs, written):
        if file.exists() and path.exists() and file.samefile(path):
            raise UsageError(f"{file} would be overwritten; write elsewhere (--out DIR)")


def require_within(out: Path, *places: Path) -> None:
    """Refuse to write where a link leads out of the results folder: the user may not know of the link."""
    for path in places:
        real = Path(os.path.realpath(path))
        if not real.is_relative_to(os.path.realpath(out)):
            raise RefusedError(f"{path} leads to {real}, outside {out}, where nothing is written; remove the link")


def write_files(files: Mapping[Path, bytes | Iterable[bytes]], within: Path | None = None) -> None:
    """Write files, with the folders that they need; within a folder, unless the user named the files."""
    for path, content in files.items():
        if within is not None:
            require_within(within, path)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_file(path, content)
        except FileExistsError as error:
            raise StorageError(f"{error.filename} is a file, not a folder to write in") from error
        except OSError as error:
            raise StorageError(f"{error.filename or path} cannot be written: {error.strerror or error}") from error


def printable(text: str) -> str:
    """Return a message without control characters of a terminal: quoted text may come from anywhere."""
    return "".join(c if c.isprintable() or c in "\n\t" else c.encode("unicode_escape").decode() for c in text)


def guarded(function: Function) -> Function:
    """Turn the exceptions of a command into one message and an exit code, and its option groups into options."""
    command = with_option_groups(function)

    @functools.wraps(command)
    def wrapper(*args: Any, **kwargs: Any) -> None:
        try:
            with interruptible():
                command(*args, **kwargs)
        except CtidError as error:
            # Problems of a specification begin with file:line:column, which editors turn into links.
            typer.echo(printable(str(error) if isinstance(error, SpecError) else f"ctid: {error}"), err=True)
            raise typer.Exit(error.exit_code) from None
        except (typer.Exit, typer.Abort, BrokenPipeError):
            raise
        except OSError as error:
            if error.errno == errno.ENAMETOOLONG:
                typer.echo(f"ctid: {str(error.filename)[:40]}...: the name is too long for a file", err=True)
                raise typer.Exit(ExitCode.BAD_INPUT) from None
            if error.errno not in _OF_THE_DISK and "temporary directory" not in str(error):
                _report(error, kwargs.get("out"))
            where = f"{error.filename}: " if error.filename else ""
            typer.echo(f"ctid: {where}{error.strerror or error}; what was reported as done is safe", err=True)
            raise typer.Exit(ExitCode.STORAGE) from None
        except Exception as error:
            _report(error, kwargs.get("out"))

    return cast(Function, wrapper)


def _report(error: Exception, out: Path | None) -> NoReturn:
    """Report an unforeseen error, and where its details are."""
    file, kind = _write_traceback(out), type(error).__name__
    typer.echo(f"ctid: unexpected error ({kind}: {_one_line(error)}); please report it with {file}", err=True)
    raise typer.Exit(ExitCode.INTERNAL) from None


def _one_line(error: Exception) -> str:
    text = printable(" ".join(str(error).split()))
    return text if len(text) <= 200 else text[:200] + "..."


def _write_traceback(out: Path | None) -> Path:
    name = f"ctid-error-{time.strftime('%Y%m%d-%H%M%S')}-{os.getpid()}.txt"
    text = f"arguments: {sys.argv}\n\n{traceback.format_exc()}"
    for folder in (out if out is not None and out.is_dir() else None, None):
        with contextlib.suppress(OSError):
            place = Path(tempfile.gettempdir()) if folder is None else folder
            write_file(place / name, text.encode())
            return place / name
    typer.echo(text, err=True)
    return Path("the text above")
