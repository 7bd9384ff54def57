"""YAML parsing without implicit conversions, with the place of every key and value.

PyYAML parses the syntax; the values are built here, because only the tree of nodes has lines and columns. A plain
scalar is

- ``null`` if it is empty, ``~`` or ``null``,
- a boolean if it is exactly ``true`` or ``false`` (``no``, ``on``, ``True`` are text),
- a whole number if it is decimal digits with an optional sign (``010`` is ten),
- a number if it looks like one, exponents without a point included (``1e-3``), and ``.inf`` or ``.nan``,
- text otherwise: dates, ``1:30``, ``0x1F`` and ``1_000`` too.

Merge keys (``<<``) are refused: a reader cannot see from which mapping a merged key comes, and a plain alias
(``b: *a``) is explicit.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import yaml

from ctid_cli.canonical import plain
from ctid_cli.errors import Problem, SpecError, UsageError
from ctid_cli.signals.files import require_file
from ctid_cli.text import did_you_mean

#: Keys and list indices that lead from the top of a file to a value.
KeyPath = tuple[str | int, ...]
#: Last item of a path if the key is wrong and not its value; defined by pydantic.
KEY = "[key]"

#: Maximum file size [bytes]; larger files are not specifications, or have an alias that multiplies itself.
MAX_BYTES = 250_000
MAX_VALUES = 100_000
#: Maximum number of characters of a key repeated in a message.
MAX_KEY = 60

#: File name in problems with a ``--set`` option.
OVERRIDE_FILE = "--set"

_TAG = "tag:yaml.org,2002:"
_SCALARS: dict[str, re.Pattern[str]] = {
    "null": re.compile(r"(?:~|null|Null|NULL|)\Z"),
    "bool": re.compile(r"(?:true|false)\Z"),
    "int": re.compile(r"[-+]?[0-9]+\Z"),
    "float": re.compile(
        r"(?:[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))\Z"
    ),
}


class _Loader(yaml.SafeLoader):
    """PyYAML's safe loader with a custom table of plain scalars in place of YAML 1.1's."""

    # A new table: add_implicit_resolver would copy, and thus keep, the rules of the parent.
    yaml_implicit_resolvers: dict[str | None, list[tuple[str, re.Pattern[str]]]] = {  # noqa: RUF012
        None: [(_TAG + name, pattern) for name, pattern in _SCALARS.items()]
    }


def problem_at(mark: Any, path: KeyPath, message: str) -> Problem:
    """Return a problem at a PyYAML mark, which contains the file name."""
    return Problem(mark.name, mark.line + 1, mark.column + 1, path_text(path), message)


def _mark(file: str, line: int = 0, column: int = 0) -> Any:
    """Return a mark at a line and column, counted from 0."""
    return yaml.Mark(file, 0, line, column, None, 0)


@dataclass
class YamlSource:
    """Values of a YAML text with their places."""

    file: str
    #: The text, if it came from a file.
    text: str = ""
    tree: Any = None
    #: The node of each value, and that of its key in a mapping.
    nodes: dict[KeyPath, tuple[Any, Any]] = field(default_factory=dict)
    problems: list[Problem] = field(default_factory=list)

    def mark(self, path: KeyPath) -> Any:
        """Return the place for reporting a problem: the key for mappings and wrong keys, otherwise the value."""
        key = False
        while path and path not in self.nodes:
            path, key = path[:-1], True
        value, name = self.nodes.get(path, (None, None))
        node = name if name is not None and (key or isinstance(value, yaml.MappingNode)) else value
        return _mark(self.file) if node is None else node.start_mark

    def problem(self, path: KeyPath, message: str) -> Problem:
        """Return a problem at a key path."""
        return problem_at(self.mark(path), path, message)

    def build(self, node: Any, path: KeyPath = (), name: Any = None, parents: tuple[Any, ...] = ()) -> Any:
        """Return the value of a node; add errors to the problems."""
        self.nodes[path] = node, name
        fatal = ""
        if len(self.nodes) > MAX_VALUES:
            fatal = f"more than {MAX_VALUES} values, those of aliases too"
        elif any(node is parent for parent in parents):
            fatal = "an alias refers to its own parent"
        if fatal:
            raise SpecError([*self.problems, problem_at(node.start_mark, path, fatal)])
        if isinstance(node, yaml.ScalarNode):
            return self._scalar(node, path)
        if node.tag != _TAG + ("seq" if isinstance(node, yaml.SequenceNode) else "map"):
            self._refuse_tag(node, path, "a plain list or mapping")
        if isinstance(node, yaml.SequenceNode):
            return [self.build(item, (*path, k), None, (*parents, node)) for k, item in enumerate(node.value)]
        return self._mapping(node, path, (*parents, node))

    def _mapping(self, node: Any, path: KeyPath, parents: tuple[Any, ...]) -> dict[str, Any]:
        mapping: dict[str, Any] = {}
        for name, value in node.value:
            here, wrong = path, ""
            if not isinstance(name, yaml.ScalarNode):
                wrong = "a key must be a plain word"
            else:
                here = (*path, name.value)
                if name.value == "<<":
                    wrong = "merge keys (<<) are not supported; write the keys out, or use an alias for a whole value"
                elif name.value in mapping:
                    first = self.mark((*here, KEY)).line + 1
                    wrong = f"the key {path_text((name.value,))!r} is given twice, first on line {first}; keep one"
            if wrong:
                self.problems.append(problem_at(name.start_mark, here, wrong))
            else:
                mapping[name.value] = self.build(value, here, name, parents)
        return mapping

    def _scalar(self, node: Any, path: KeyPath) -> Any:
        text: str = node.value
        tag: str = node.tag.removeprefix(_TAG)
        if tag == "str":
            return text
        # An explicit tag (!!float abc) may contradict its text, so the pattern is checked again.
        if tag not in _SCALARS or not _SCALARS[tag].match(text):
            return self._refuse_tag(node, path, "the plain value")
        if tag == "null":
            return None
        if tag == "bool":
            return text == "true"
        if tag == "int":
            # Python refuses very long digit strings; such values are read as floating-point numbers.
            return int(text) if len(text) < 400 else float(text)
        return float(re.sub(r"\.(?=[a-zA-Z])", "", text))  # Python writes .inf and .nan without their point

    def _refuse_tag(self, node: Any, path: KeyPath, instead: str) -> None:
        message = f"the tag {node.tag.replace(_TAG, '!!')} cannot be used here; write {instead}"
        self.problems.append(problem_at(node.start_mark, path, message))


def path_text(path: KeyPath) -> str:
    """Return a key path in the notation of users."""
    text = ""
    for part in path[:-1] if path[-1:] == (KEY,) else path:
        word = part if isinstance(part, int) or len(part) <= MAX_KEY else part[: MAX_KEY - 1] + "…"
        text += f"[{part}]" if isinstance(part, int) else f"{'.' if text else ''}{word}"
    return text


def read_yaml(path: Path, overrides: Iterable[str] = ()) -> YamlSource:
    """Read a YAML file, with some values replaced."""
    if path.is_dir():
        raise UsageError(f"{path}: this is a folder; name the YAML file in it")
    if path.is_file() and path.stat().st_size == 0:
        raise SpecError([problem_at(_mark(str(path)), (), "the file is empty")])
    try:
        require_file(path)
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise UsageError(f"{path}: the file cannot be read: {error.strerror or error}") from None
    if len(data) > MAX_BYTES:
        raise UsageError(f"{path}: the file has too many bytes for a specification (at most {MAX_BYTES})")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        before = data[: error.start]
        mark = _mark(str(path), before.count(b"\n"), error.start - before.rfind(b"\n") - 1)
        raise SpecError([problem_at(mark, (), "the file is not UTF-8 text; save it as UTF-8")]) from None
    return parse_yaml(text, str(path), overrides)


def written(tree: Mapping[str, Any]) -> str:
    """Return a mapping as YAML text."""
    try:
        return str(yaml.safe_dump(plain(tree), sort_keys=False, allow_unicode=True))
    except yaml.YAMLError as error:
        what = type(error.args[-1]).__name__
        raise UsageError(f"a specification holds texts, numbers, lists and mappings, and here is a {what}") from None


def parse_yaml(text: str, file: str, overrides: Iterable[str] = ()) -> YamlSource:
    """Return the values and places of a YAML text; overrides ``key.path=value`` replace values."""
    source, root = YamlSource(file, text), _composed(text, file)
    for number, override in enumerate(overrides, start=1):
        try:
            root = _overridden(root, override, number)
        except SpecError as error:
            source.problems += error.problems
    if root is not None:
        source.tree = source.build(root)
    if source.problems:
        raise SpecError(source.problems)
    return source


def _composed(text: str, file: str) -> Any:
    """Return the tree of nodes of a YAML text, with the file in its marks; None for an empty text."""
    try:
        loader = _Loader(text)
        loader.name = file
        return loader.get_single_node()
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        if error.context_mark is not None and "end" in (error.problem or "") and "stream" in (error.problem or ""):
            mark = error.context_mark  # the place of the unclosed item is more useful than the end of the file
        raise SpecError([problem_at(mark, (), _syntax_message(error))]) from None
    except yaml.reader.ReaderError as error:
        before = text[: error.position]
        mark = _mark(file, before.count("\n"), error.position - before.rfind("\n") - 1)
        code = ord(error.character) if isinstance(error.character, str) else error.character
        raise SpecError([problem_at(mark, (), f"the character U+{code:04X} is not allowed in YAML")]) from None
    except RecursionError:
        raise SpecError([problem_at(_mark(file), (), "lists or mappings are nested too deeply")]) from None


def _overridden(root: Any, override: str, number: int) -> Any:
    """Return the tree of nodes with a value set by ``--set a.b=value``; the value's place is in that option."""
    key, equals, text = override.partition("=")
    path = tuple(part.strip() for part in key.split("."))
    here = _mark(OVERRIDE_FILE, number - 1)

    def refuse(message: str) -> SpecError:
        problem = problem_at(here, (), f"{message} (in --set {override!r})")
        return SpecError([replace(problem, key=key.strip())])

    if not equals or not all(path):
        raise refuse("an override is written key.path=value, for example noise.snr_db=[5,15]")
    # Columns count within the option.
    before = "\n" * (number - 1) + ("" if "\n" in text else " " * (len(key) + 1))
    value = _composed(before + text, OVERRIDE_FILE) or yaml.ScalarNode(_TAG + "null", "", here)

    def with_value(node: Any, depth: int) -> Any:
        """Return a copy of the mapping with the new value; nodes shared by aliases are not changed."""
        if depth == len(path):
            return value
        if node is None or node.tag == _TAG + "null":
            node = yaml.MappingNode(_TAG + "map", [], here)
        if not isinstance(node, yaml.MappingNode):
            place = path_text(path[:depth]) or "the file"
            raise refuse(f"{place} is not a mapping, so nothing can be set inside it")
        part, items = path[depth], list(node.value)
        names = [name.value for name, _ in items]
        if part not in names:
            if path[0] == "estimators" and depth == 1 < len(path) - 1:
                known = ", ".join(sorted(names)) or "none"
                raise refuse(f"there is no estimator {part!r}{did_you_mean(part, names)} Estimators here: {known}")
            names.append(part)
            items.append((yaml.ScalarNode(_TAG + "str", part, here), None))
        name, old = items[names.index(part)]
        name = name if depth < len(path) - 1 else yaml.ScalarNode(_TAG + "str", part, here)
        items[names.index(part)] = name, with_value(old, depth + 1)
        return yaml.MappingNode(node.tag, items, node.start_mark)

    return with_value(root, 0)


def _syntax_message(error: yaml.MarkedYAMLError) -> str:
    """Return PyYAML's error as a sentence, with its usual cause if known."""
    problem = (error.problem or "the text is not valid YAML").strip()
    if "'\\t'" in problem:
        return "a tab is not allowed here; indent with spaces"
    if "but found another document" in problem:
        return "the file holds more than one YAML document ('---'); keep one experiment per file"
    context = f" ({error.context.strip()})" if error.context else ""
    hints = {
        "mapping values are not allowed": "; a key needs a colon, keys of a mapping the same indentation, "
        "text with a colon quotes",
        "could not find expected ':'": "; a key needs a colon and a space after it",
        "expected ',' or '}'": "; separate the entries by commas and close the brace",
        "expected ',' or ']'": "; separate the items by commas and close the bracket",
        "expected <block end>": "; check the indentation of this line",
        "found undefined alias": "; define it before with &name",
    }
    hint = next((text for start, text in hints.items() if start in problem), "")
    return f"this is not valid YAML: {problem}{context}{hint}"
