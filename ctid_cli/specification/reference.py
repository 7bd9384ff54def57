"""Reference of experiment files as text: type, unit, default and meaning of every key, from the JSON Schema."""

import json
import re
from collections.abc import Iterator, Mapping
from typing import Any

from ctid_cli.errors import UsageError
from ctid_cli.specification.load import json_schema
from ctid_cli.text import did_you_mean, wrapped

Node = Mapping[str, Any]

_TYPES = {"number": "number", "integer": "whole number", "string": "text", "boolean": "true or false"}
_LIMITS = {"exclusiveMinimum": "above", "minimum": "at least", "exclusiveMaximum": "below", "maximum": "at most"}
#: Limits this large come from number formats; the reference omits them.
_ENORMOUS = 10**15
_UNIT = re.compile(r" \[([^],…]+)\]")
#: Python constants in YAML notation.
_IN_YAML = {"None": "null", "True": "true", "False": "false"}
_LEGEND = (
    "Keys of experiment files: type, [unit], default, meaning. '- kind:' begins one of several forms. '(or a list)': "
    "every value of the list makes a case of its own, unless the text says otherwise. One section or kind alone: "
    "ctid schema --text sampling, ctid schema --text td_srivc"
)


def reference_text(word: str | None = None) -> str:
    """Return the reference of all keys, or of those of a section or kind."""
    schema = json_schema()
    sections: Mapping[str, Node] = schema["properties"]
    if word is None:
        return "\n".join([wrapped(_LEGEND), "", *_keys(schema, schema["$defs"], "")]).rstrip()
    names = [name for name, node in sections.items() if word in _kinds(node, schema["$defs"])]
    names = [word] if word in sections else names
    if not names:
        kinds = [kind for node in sections.values() for kind in _kinds(node, schema["$defs"])]
        near = did_you_mean(word, [*sections, *kinds]) or f"; sections: {', '.join(sections)}"
        raise UsageError(f"no section or kind of an experiment file is called {word!r}{near}")
    part = {"properties": {name: sections[name] for name in names}, "required": schema["required"]}
    return "\n".join(_keys(part, schema["$defs"], "", None if word in sections else word)).rstrip()


def unit_of(section: str, key: str) -> str:
    """Return the unit of a key of a section; empty if it has none."""
    schema = json_schema()
    forms = _mappings(schema["properties"].get(section, {}), schema["$defs"])
    texts = (_plain(form["properties"][key]) for form in forms if key in form["properties"])
    return next((unit[1] for text in texts if (unit := _UNIT.search(text)) and unit[1] != "-"), "")


def _kinds(node: Node, defs: Node) -> list[str]:
    return [kind for form in _mappings(node, defs) if (kind := _kind(form)) is not None]


def _kind(form: Node) -> str | None:
    kind: str | None = form["properties"].get("kind", {}).get("const")
    return kind


def _keys(form: Node, defs: Node, indent: str, only: str | None = None) -> Iterator[str]:
    """Yield lines about the keys of a mapping, optionally of one kind only."""
    for key, node in form["properties"].items():
        if key == "kind" and "const" in node:
            continue
        head, text = f"{key}: {_type(node, defs)}", _plain(node)
        if "number" in head:  # a text with a unit is the name of a column
            unit = _UNIT.search(text)
            head, text = head + (unit[0] if unit else ""), _UNIT.sub("", text, count=1)
        several = " (or a list)" if _list_form(node, defs) else ""
        yield wrapped(f"{head}{several}; {_presence(key, node, form)}", indent, indent + "    ")
        if text:
            yield wrapped(text, indent + "    ")
        forms = _mappings(node, defs)
        for each in [each for each in forms if only in (None, _kind(each))]:
            if len(forms) > 1:
                title = f"- kind: {_kind(each)}. " if _kind(each) else "- "
                yield wrapped(title + _plain(each), indent + "  ", indent + "    ")
            yield from _keys(each, defs, indent + "    ")
        if not indent:
            yield ""


def _plain(node: Node) -> str:
    """Return the description of a value or mapping with YAML constants."""
    text = node.get("description", "").replace("``", "")
    return re.sub(r"\b(None|True|False)\b", lambda word: _IN_YAML[word[0]], text)


def _presence(key: str, node: Node, form: Node) -> str:
    if key in form.get("required", ()):
        return "required"
    default = node.get("default")
    if default is None:
        return "optional"
    return f"default {default if isinstance(default, str) else json.dumps(default)}"


def _alternatives(node: Node, defs: Node) -> list[Node]:
    """Return the forms of a value, without null."""
    if "$ref" in node:
        return [defs[node["$ref"].rpartition("/")[2]]]
    among = node.get("oneOf") or node.get("anyOf")
    if among is None:
        return [] if node.get("type") == "null" else [node]
    return [form for each in among for form in _alternatives(each, defs)]


def _mappings(node: Node, defs: Node) -> list[Node]:
    """Return the mappings that a value, the items of a list, or the values of a mapping by names may be."""
    found: list[Node] = []
    for form in _alternatives(node, defs):
        inner = form.get("items") or form.get("additionalProperties")
        new = [form] if "properties" in form else _mappings(inner, defs) if inner else []
        found += [each for each in new if each not in found]
    return found


def _list_form(node: Node, defs: Node) -> Node | None:
    """Return the list form of a value, if a list is allowed in its place."""
    forms = _alternatives(node, defs)
    lists = [form for form in forms if form.get("type") == "array"]
    same = [form for form in lists if _alternatives(form.get("items", {}), defs)[0] in forms]
    return same[0] if same else None


def _type(node: Node, defs: Node) -> str:
    """Return the types of a value as text."""
    listed = _list_form(node, defs)
    return " or ".join(dict.fromkeys(_one_type(form, defs) for form in _alternatives(node, defs) if form is not listed))


def _one_type(form: Node, defs: Node) -> str:
    if "enum" in form or "const" in form:
        return " | ".join(map(str, form.get("enum") or [form["const"]]))
    if form.get("type") == "array":
        least, most = form.get("minItems"), form.get("maxItems")
        count = f"{least} " if least == most and least else ""
        return (
            f"list of {count}{re.sub(r'number|text|mapping', lambda word: word[0] + 's', _type(form['items'], defs))}"
        )
    if form.get("additionalProperties"):
        return "mapping of names to mappings"
    given = {words: form[limit] for limit, words in _LIMITS.items() if limit in form}
    limits = ", ".join(f"{words} {value:.15g}" for words, value in given.items() if value < _ENORMOUS)
    return f"{_TYPES.get(form.get('type', ''), 'mapping')} {limits}".strip()
