"""What all commands share: the results option, and how errors reach the user."""

from __future__ import annotations

import contextlib
import functools
import os
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar, cast

import typer

from ctid_cli.errors import CtidError, SpecError, StorageError

Command = TypeVar("Command", bound=Callable[..., None])

Out = Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder that holds the results.")]
Json = Annotated[bool, typer.Option("--json", help="Write JSON to stdout instead of text.")]

INTERRUPTED = 130


def write_files(files: Mapping[Path, bytes]) -> None:
    """Write files, and make the folders that they need."""
    for path, content in files.items():
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        except OSError as error:
            raise StorageError(f"{error.filename or path} cannot be written: {error.strerror or error}") from error


def guarded(command: Command) -> Command:
    """Turn the exceptions of a command into one message and an exit code."""

    @functools.wraps(command)
    def wrapper(*args: Any, **kwargs: Any) -> None:
        try:
            command(*args, **kwargs)
        except CtidError as error:
            # Problems of a specification begin with file:line:column, which editors turn into links.
            typer.echo(str(error) if isinstance(error, SpecError) else f"ctid: {error}", err=True)
            raise typer.Exit(error.exit_code) from None
        except KeyboardInterrupt:
            raise typer.Exit(INTERRUPTED) from None
        except (typer.Exit, typer.Abort, BrokenPipeError):
            raise
        except Exception as error:
            file = _write_traceback(kwargs.get("out"))
            kind = type(error).__name__
            typer.echo(f"ctid: unexpected error ({kind}: {_one_line(error)}); please report it with {file}", err=True)
            raise typer.Exit(1) from None

    return cast(Command, wrapper)


def _one_line(error: Exception) -> str:
    text = " ".join(str(error).split())
    return text if len(text) <= 200 else text[:200] + "..."


def _write_traceback(out: Path | None) -> Path:
    name = f"ctid-error-{time.strftime('%Y%m%d-%H%M%S')}-{os.getpid()}.txt"
    text = f"arguments: {sys.argv}\n\n{traceback.format_exc()}"
    folders = [Path(tempfile.gettempdir())] if out is None or not out.is_dir() else [out, Path(tempfile.gettempdir())]
    for folder in folders:
        with contextlib.suppress(OSError):
            (folder / name).write_text(text, encoding="utf-8")
            return folder / name
    typer.echo(text, err=True)
    return Path("the text above")
