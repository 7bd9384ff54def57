"""Schemas of printed JSON: docs/schemas has one for each object with ``schema`` or ``kind``, and for each list."""

import json
from functools import cache
from pathlib import Path

from jsonschema import Draft202012Validator

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "schemas"
#: Schemas of lists, which do not contain their name, by command.
LISTS = {"table": "ctid-table-1", "export": "ctid-estimates-1", "reproduce": "ctid-studies-1"}


@cache
def validator(name):
    schema = json.loads((FOLDER / f"{name}.json").read_text(encoding="utf-8"))
    Draft202012Validator.check_schema(schema)
    return Draft202012Validator(schema)


def validate_json(command, text):
    """Validate the JSON that a command printed: one value, or one object on each line."""
    try:
        found = [json.loads(text)]
    except ValueError:
        found = [json.loads(line) for line in text.splitlines()]
    for each in found:
        if isinstance(each, list):
            name = LISTS[command]
        else:
            name = each.get("schema") or f"{each['kind'].replace(' ', '-')}-{each['format']}"
        validator(name).validate(each)
