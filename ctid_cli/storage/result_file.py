"""Files of one result each, such as ``fit.json``: kind, format, checksum, and records.

Results are stored as plain data without loss: numbers to the last bit, arrays with their shapes. Only classes in the
annotations of the result's classes are created when reading: a file cannot name a class.
"""

import dataclasses
import json
import math
import os
import types
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Any, Literal, NamedTuple, NoReturn, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

import ctid_cli
from ctid_cli.canonical import content_hash, read_json
from ctid_cli.errors import DataError
from ctid_cli.inference.fit import DeferredFields
from ctid_cli.signals.files import file_sha256, require_file

#: Maximum size of a file that is read [bytes]; ten thousand bootstrap draws need less.
MAX_BYTES = 200_000_000


class ResultKind(NamedTuple):
    """A kind of result file."""

    kind: str
    #: The format that is written, and the newest that can be read.
    format: int
    #: Noun for messages, as in "this is no fit", and the command that makes it.
    noun: str
    command: str
    #: Alternative to using another record, for messages, as in "or fit again".
    again: str
    #: The oldest format that can be read.
    oldest: int = 1

    def text(self, content: Mapping[str, Any], command: str | None) -> str:
        """Return the text of a file, including the fields that every reader verifies."""
        whole = {"kind": self.kind, "format": self.format, "ctid": ctid_cli.__version__, "command": command, **content}
        text = json.dumps(whole, allow_nan=False)
        return json.dumps(whole | {"checksum": content_hash(json.loads(text))}, allow_nan=False)

    def content(self, file: str) -> dict[str, Any]:
        """Return the content of a file after verifying its kind and checksum."""
        content = self._json(file)
        if not isinstance(content, dict) or content.get("kind") != self.kind:
            self.refuse(file, self._what_else(content))
        if not isinstance(content.get("format"), int) or content["format"] > self.format:
            written = f"was written by a newer ctid ({str(content.get('ctid'))[:20]}): its format is "
            self.refuse(file, f"{written}{str(content.get('format'))[:20]}, and this one reads up to {self.format}")
        if content["format"] < self.oldest:
            self.refuse(file, f"was written by an older ctid and cannot be read back; {self.again}")
        if content.get("checksum") != content_hash({key: item for key, item in content.items() if key != "checksum"}):
            self.refuse(file, "is damaged, or was changed after it was written: its checksum is that of other content")
        return content

    def kind_in(self, file: str) -> str | None:
        """Return the kind of result in a file; refuse a file that cannot be read."""
        content = self._json(file)
        return content["kind"] if isinstance(content, dict) and isinstance(content.get("kind"), str) else None

    @contextmanager
    def refusing(self, file: str) -> Iterator[None]:
        """Refuse a file with invalid content."""
        try:
            yield
        except (KeyError, TypeError, IndexError, AttributeError, ValueError, DataError, OverflowError) as error:
            self.refuse(file, f"is damaged ({str(error)[:200]})")

    def refuse(self, file: str, what: str) -> NoReturn:
        """Raise an error with the reason and the command that writes such files."""
        raise DataError(f"{file} {what}; {self.command} writes such a file")

    def _json(self, file: str) -> Any:
        require_file(file)
        if (size := os.stat(file).st_size) > MAX_BYTES:
            raise DataError(f"{file}: {size} bytes are too many for a {self.noun}; at most {MAX_BYTES} are read")
        try:
            return read_json(Path(file).read_text(encoding="utf-8"))
        except OSError as error:
            raise DataError(f"{file}: the file cannot be read: {error.strerror or error}") from None
        except (ValueError, RecursionError) as error:
            self.refuse(file, f"is no JSON, or damaged ({str(error)[:200]})")

    def _what_else(self, content: Any) -> str:
        """Describe a file of another kind."""
        if not isinstance(content, dict):
            return f"is no {self.noun}"
        if isinstance(content.get("kind"), str):
            return f"is no {self.noun} but of kind {content['kind'][:40]!r}"
        if "parameters" in content and "residual_tests" in content:
            return "is a fit of an older ctid, which cannot be read back"
        return f"is another kind of result than a {self.noun}"


def path_and_sum(path: str | os.PathLike[str], folder: Path) -> dict[str, Any]:
    """Return the path of a record relative to a folder, and its SHA-256."""
    place, home = Path(os.path.abspath(path)), Path(os.path.abspath(folder))
    below = place.is_relative_to(home)
    shown = place.relative_to(home).as_posix() if below else str(place)
    return {"path": shown, "sha256": file_sha256(str(place))}


@dataclass(frozen=True)
class Source:
    """A record named in the file of a result."""

    kind: ResultKind
    #: The file that names the record.
    owner: str
    content: Mapping[str, Any]
    #: Its new path, if it moved.
    moved: str | None = None

    @property
    def name(self) -> str:
        """Name of the record."""
        return str(self.content["file"])

    @property
    def place(self) -> str:
        """Path from which the record is read."""
        return self.moved or str(Path(os.path.abspath(self.owner)).parent / str(self.content["path"]))

    def require_same(self) -> None:
        """Refuse a record that differs from that of the result."""
        if self.moved is None and not Path(self.place).exists():
            cure = "say where it is now: --record FILE"
            raise DataError(f"{self.owner}: its record {self.place} does not exist; {cure}")
        if file_sha256(self.place) != self.content["sha256"]:
            what = f"{self.place} is not the file that the {self.kind.noun} is of (its SHA-256 is another)"
            raise DataError(f"{self.owner}: {what}; name that one with --record FILE, or {self.kind.again}")


def texts(values: Iterable[Any]) -> bool:
    """Return whether all values are texts."""
    return all(isinstance(value, str) for value in values)


def require(what: str, right: bool) -> None:
    """Refuse a file in which a part is invalid."""
    if not right:
        raise DataError(f"its {what}")


# --- results as plain data ------------------------------------------------------------------------------------------

#: Numbers that JSON does not have.
_NOT_FINITE = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}


def encoded(value: Any) -> Any:
    """Return a result as JSON-compatible data, without deferred fields."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        kept = {name: encoded(getattr(value, name)) for name in _hints(type(value))}
        return {"type": type(value).__name__, **kept}
    if isinstance(value, np.ndarray):
        numbers = [_number(item) for item in value.ravel().tolist()]
        return numbers if value.ndim == 1 else {"shape": list(value.shape), "values": numbers}
    if isinstance(value, Enum):
        return value.name
    if isinstance(value, tuple | list):
        return [encoded(item) for item in value]
    if isinstance(value, Mapping):
        return {"type": "Mapping", "values": {name: encoded(item) for name, item in value.items()}}
    return _number(value.item() if isinstance(value, np.generic) else value)


def _number(value: Any) -> Any:
    if isinstance(value, complex):
        return [_number(value.real), _number(value.imag)]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value


def decoded(content: Any, hint: Any, place: str = "result") -> Any:
    """Return the value of an annotated type from encoded data."""
    origin, choices = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return _one_of(content, choices, place)
    if origin is Literal:
        return content if content in choices else _refuse_part(place)
    if origin in (np.ndarray, NDArray):  # the latter from NumPy 2.5 on, without the type of the shape
        return _array(content, np.dtype((get_args(choices[-1]) or choices)[-1]), place)
    if origin in (tuple, Sequence):
        return _sequence(content, choices, place)
    if origin is Mapping:
        values = content.get("values") if isinstance(content, Mapping) else None
        if not isinstance(values, Mapping):
            _refuse_part(place)
        return {name: decoded(item, choices[1], f"{place}.{name}") for name, item in values.items()}
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        return _instance(content, hint, place)
    if isinstance(hint, type) and hasattr(hint, "_fields"):
        return hint(*_sequence(content, list(get_type_hints(hint).values()), place))
    if isinstance(hint, type) and issubclass(hint, Enum):
        return hint[content] if isinstance(content, str) and content in hint.__members__ else _refuse_part(place)
    return _plain(content, hint, place)


def _one_of(content: Any, choices: Sequence[Any], place: str) -> Any:
    if content is None and type(None) in choices:
        return None
    left = [choice for choice in choices if choice is not type(None)]
    if isinstance(content, Mapping) and len(left) > 1:
        left = [choice for choice in left if getattr(choice, "__name__", "") == content.get("type")]
    for choice in left[:-1]:
        with suppress(DataError):
            return decoded(content, choice, place)
    return decoded(content, left[-1], place) if left else _refuse_part(place)


def _sequence(content: Any, choices: Sequence[Any], place: str) -> tuple[Any, ...]:
    if not isinstance(content, list):
        _refuse_part(place)
    if choices and choices[-1] is not Ellipsis and len(choices) > 1 and len(choices) != len(content):
        _refuse_part(place)
    hints = choices if len(choices) == len(content) and Ellipsis not in choices else [choices[0]] * len(content)
    return tuple(
        decoded(item, each, f"{place}[{k}]") for k, (item, each) in enumerate(zip(content, hints, strict=True))
    )


def _array(content: Any, dtype: Any, place: str) -> Any:
    shape = content.get("shape") if isinstance(content, Mapping) else None
    values = content.get("values") if isinstance(content, Mapping) else content
    one: Any = {"f": float, "c": complex, "b": bool}.get(dtype.kind, int)
    array = np.array(_sequence(values, (one, Ellipsis), place), dtype=dtype)
    return array if shape is None else array.reshape(_sequence(shape, (int, Ellipsis), place))


def _instance(content: Any, kind: type, place: str) -> Any:
    hints = _hints(kind)
    # Older files lack fields added since.
    missing = dataclasses.MISSING
    added = (each for each in dataclasses.fields(kind) if (each.default, each.default_factory) != (missing, missing))
    later = {each.name for each in added} & {*hints}
    known = isinstance(content, Mapping) and content.get("type") == kind.__name__
    if not known or not {*hints} - later <= {*content} - {"type"} <= {*hints, *getattr(kind, "former", ())}:
        _refuse_part(place)
    values = {name: decoded(content[name], hint, f"{place}.{name}") for name, hint in hints.items() if name in content}
    late = dict.fromkeys(kind.deferred, ()) if issubclass(kind, DeferredFields) else {}
    found = kind(**values, **late)
    # What a field of an earlier version says may be in another one now.
    former = {name: content[name] for name in getattr(kind, "former", ()) if name in content}
    try:
        return found.of_former(former) if former and hasattr(found, "of_former") else found
    except (TypeError, ValueError):
        _refuse_part(place)


def _plain(content: Any, hint: Any, place: str) -> Any:
    if hint is float and isinstance(content, str) and content in _NOT_FINITE:
        return _NOT_FINITE[content]
    if hint is complex and isinstance(content, list) and len(content) == 2:
        return complex(*(_plain(part, float, place) for part in content))
    if hint is float and isinstance(content, int) and not isinstance(content, bool):
        return content
    return content if type(content) is hint else _refuse_part(place)


@cache
def _hints(kind: type) -> dict[str, Any]:
    """Return the stored fields with their annotations."""
    late = kind.deferred if issubclass(kind, DeferredFields) else ()
    hints = get_type_hints(kind)
    return {each.name: hints[each.name] for each in dataclasses.fields(kind) if each.init and each.name not in late}


def _refuse_part(place: str) -> NoReturn:
    raise DataError(f"{place} is not what a fit has there")
