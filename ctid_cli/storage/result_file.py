"""Files of one result each, such as ``fit.json``: kind, format, checksum, and the records that they are of."""

import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import ctid_cli
from ctid_cli.canonical import content_hash
from ctid_cli.errors import DataError
from ctid_cli.signals.files import require_file
from ctid_cli.simulation.dataset import file_sha256
from ctid_cli.storage.foreign import read_json

#: Bytes of the largest file that is read; ten thousand draws of a bootstrap need less.
MAX_BYTES = 200_000_000


class ResultKind(NamedTuple):
    """A kind of file."""

    kind: str
    #: The format that is written, and the newest that is read.
    format: int
    #: What it is, as in "this is no fit", and the command that makes it.
    noun: str
    command: str
    #: What to do instead of using another record, as in "or fit again".
    again: str
    #: The oldest format that is read.
    oldest: int = 1


def result_text(kind: ResultKind, content: Mapping[str, Any], command: str | None) -> str:
    """The file's text, with what every reader compares."""
    whole = {"kind": kind.kind, "format": kind.format, "ctid": ctid_cli.__version__, "command": command, **content}
    text = json.dumps(whole, allow_nan=False)
    return json.dumps(whole | {"checksum": content_hash(json.loads(text))}, allow_nan=False)


def path_and_sum(path: str | os.PathLike[str], folder: Path) -> dict[str, Any]:
    """Where a record lies, seen from a folder, and its SHA-256."""
    place, home = Path(os.path.abspath(path)), Path(os.path.abspath(folder))
    below = place.is_relative_to(home)
    shown = place.relative_to(home).as_posix() if below else str(place)
    return {"path": shown, "sha256": file_sha256(str(place))}


@dataclass(frozen=True)
class Source:
    """A record as the file of a result names it."""

    kind: ResultKind
    #: The file that names it, and the record's own as it was called then.
    owner: str
    name: str
    content: Mapping[str, Any]
    #: Where it is now, if it moved.
    moved: str | None = None

    @property
    def place(self) -> str:
        """Where the record is looked for."""
        return self.moved or str(Path(os.path.abspath(self.owner)).parent / str(self.content["path"]))

    def require_same(self) -> None:
        """Refuse another file than the result is of."""
        if self.moved is None and not Path(self.place).exists():
            cure = "say where it is now: --record FILE"
            raise DataError(f"{self.owner}: its record {self.place} does not exist; {cure}")
        if file_sha256(self.place) != self.content["sha256"]:
            what = f"{self.place} is not the file that the {self.kind.noun} is of (its SHA-256 is another)"
            raise DataError(f"{self.owner}: {what}; name that one with --record FILE, or {self.kind.again}")


def content_of(file: str, kind: ResultKind) -> dict[str, Any]:
    """What a file says, if it is one of this kind as it was written."""
    content = _json_of(file, kind)
    if not isinstance(content, dict) or content.get("kind") != kind.kind:
        refuse(file, kind, _what_else(content, kind))
    if not isinstance(content.get("format"), int) or content["format"] > kind.format:
        written = f"was written by a newer ctid ({str(content.get('ctid'))[:20]}): its format is "
        refuse(file, kind, f"{written}{str(content.get('format'))[:20]}, and this one reads up to {kind.format}")
    if content["format"] < kind.oldest:
        refuse(file, kind, f"was written by an older ctid and cannot be read back; {kind.again}")
    if content.get("checksum") != content_hash({key: item for key, item in content.items() if key != "checksum"}):
        refuse(file, kind, "is damaged, or was changed after it was written: its checksum is that of other content")
    return content


def kind_in(file: str, kind: ResultKind) -> str | None:
    """Which kind of result a file says that it is, None if none; one that cannot be read is refused as of a kind."""
    content = _json_of(file, kind)
    return content["kind"] if isinstance(content, dict) and isinstance(content.get("kind"), str) else None


def _json_of(file: str, kind: ResultKind) -> Any:
    require_file(file)
    if (size := os.stat(file).st_size) > MAX_BYTES:
        raise DataError(f"{file}: {size} bytes are too many for a {kind.noun}; at most {MAX_BYTES} are read")
    try:
        return read_json(Path(file).read_text(encoding="utf-8"))
    except OSError as error:
        raise DataError(f"{file}: the file cannot be read: {error.strerror or error}") from None
    except (ValueError, RecursionError) as error:
        refuse(file, kind, f"is no JSON, or damaged ({str(error)[:200]})")


def texts(values: Iterable[Any]) -> bool:
    """Whether all values are texts."""
    return all(isinstance(value, str) for value in values)


def require(what: str, right: bool) -> None:
    """Refuse a file of which a part is not what it should be."""
    if not right:
        raise DataError(f"its {what}")


def refuse(file: str, kind: ResultKind, what: str) -> NoReturn:
    """Say what is wrong with a file, and what writes such files."""
    raise DataError(f"{file} {what}; {kind.command} writes such a file")


def _what_else(content: Any, kind: ResultKind) -> str:
    """What a file is that is of another kind."""
    if not isinstance(content, dict):
        return f"is no {kind.noun}"
    if isinstance(content.get("kind"), str):
        return f"is no {kind.noun} but of kind {content['kind'][:40]!r}"
    if "parameters" in content and "residual_tests" in content:
        return "is a fit of an older ctid, which cannot be read back"
    return f"is another kind of result than a {kind.noun}"
