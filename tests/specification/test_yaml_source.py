"""YAML values without implicit conversions, and their places."""

from pathlib import Path

import pytest

from ctid_cli.errors import SpecError, UsageError
from ctid_cli.specification.yaml_source import KEY, parse_yaml, read_yaml


def value(text):
    return parse_yaml(f"key: {text}", "f").tree["key"]


def place(source, path):
    found = source.problem(path, "")
    return found.file, found.line, found.column


NUMBERS = {"1e-3": 0.001, "1e3": 1000.0, "-1E+2": -100.0, ".5": 0.5, "-1.": -1.0, "7": 7, "010": 10, "+3": 3}
OTHERS = {
    "true": True,
    "false": False,
    "~": None,
    "null": None,
    "": None,
    "-.inf": float("-inf"),
    "9" * 400: float("inf"),
}
TAGGED = {"'1'": "1", "!!str 1": "1", "!!float 1.5": 1.5, "[1, {a: b}]": [1, {"a": "b"}]}
TEXTS = ["True", "no", "on", "yes", "1:30", "2026-11-21", "0x1F", "1_000", "1e"]


@pytest.mark.parametrize(("text", "expected"), [*(NUMBERS | OTHERS | TAGGED).items(), *zip(TEXTS, TEXTS, strict=True)])
def test_scalars(text, expected):
    assert value(text) == expected
    assert type(value(text)) is type(expected)


def test_nan_is_a_number():
    assert value(".nan") != value(".nan")


def test_aliases_stand_for_whole_values():
    source = parse_yaml("a: &x [1, 2]\nb: *x\n", "f")
    assert source.tree == {"a": [1, 2], "b": [1, 2]}
    assert place(source, ("b", 1)) == ("f", 1, 11)  # where the value is written


def test_places():
    source = parse_yaml("a:\n  b: [1,\n      two]\nc: {d: e}\n", "f")
    assert place(source, ("a", "b", 1)) == ("f", 3, 7)
    assert place(source, ("a", "b", 1, KEY)) == ("f", 3, 7)
    assert place(source, ("a", "b", KEY)) == ("f", 2, 3)
    assert place(source, ("c", "d")) == ("f", 4, 8)
    assert place(source, ("c",)) == ("f", 4, 1), "a mapping stands where its key does"
    assert place(source, ("c", "missing", "deeper")) == ("f", 4, 1)
    assert place(source, ()) == ("f", 1, 1)


def test_aliases_that_multiply_are_stopped():
    lines = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]" for k in range(1, 9)]
    with pytest.raises(SpecError, match="more than 100000 values"):
        parse_yaml("\n".join(lines), "f")


def test_lists_that_are_nested_too_deeply():
    with pytest.raises(SpecError, match="f:1:1: lists or mappings are nested too deeply"):
        parse_yaml("[" * 5000, "f")


def test_files_that_cannot_be_read(tmp_path):
    with pytest.raises(UsageError, match="does not exist"):
        read_yaml(tmp_path / "missing.yaml")
    with pytest.raises(UsageError, match="this is a folder"):
        read_yaml(tmp_path)
    large = tmp_path / "large.yaml"
    large.write_bytes(b"#" * 1_000_001)
    with pytest.raises(UsageError, match="too many"):
        read_yaml(large)
    latin = tmp_path / "latin.yaml"
    latin.write_bytes("a: 1\nb: é".encode("latin-1"))
    with pytest.raises(SpecError) as error:
        read_yaml(latin)
    assert [(p.line, p.column) for p in error.value.problems] == [(2, 4)]


def test_a_byte_order_mark_is_no_part_of_the_first_key(tmp_path):
    file = tmp_path / "marked.yaml"
    file.write_bytes(b"\xef\xbb\xbfa: 1\r\nb: 2\r\n")
    source = read_yaml(Path(file))
    assert source.tree == {"a": 1, "b": 2}
    assert place(source, ("a",)) == (str(file), 1, 4)


def test_overrides_replace_values_and_their_places():
    overrides = ["a.b=[5, 1e1]", "a.c={d: no}", "new.deep.key=true", "a.c.d=4"]
    source = parse_yaml("a: {b: [1, 2, 3], c: 3}\n", "f", overrides)
    assert source.tree == {"a": {"b": [5, 10.0], "c": {"d": 4}}, "new": {"deep": {"key": True}}}
    assert place(source, ("a", "b", 1)) == ("--set", 1, 9)
    assert place(source, ("a", "c", "d")) == ("--set", 4, 7)
    assert place(source, ("new", "deep")) == ("--set", 3, 1)
    assert ("a", "b", 2) not in source.nodes, "places of what was replaced are gone"
    assert parse_yaml("a: {b: 1}", "f", ["a.b="]).tree == {"a": {"b": None}}
    assert parse_yaml("a: {b: 1}", "f", ["a=c: 1\nd: 2"]).tree == {"a": {"c": 1, "d": 2}}


def test_an_override_changes_one_of_two_places_that_an_alias_shares():
    assert parse_yaml("a: &x {b: 1}\nc: *x\n", "f", ["c.b=2"]).tree == {"a": {"b": 1}, "c": {"b": 2}}
