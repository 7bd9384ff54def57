"""YAML values without YAML's traps, and the place of each."""

from pathlib import Path

import pytest

from ctid_cli.errors import SpecError, UsageError
from ctid_cli.specification.yaml_source import Place, parse_yaml, read_yaml


def value(text):
    return parse_yaml(f"key: {text}", "f").tree["key"]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1e-3", 0.001),
        ("1e3", 1000.0),
        ("-1E+2", -100.0),
        (".5", 0.5),
        ("-1.", -1.0),
        ("7", 7),
        ("010", 10),
        ("+3", 3),
        ("true", True),
        ("false", False),
        ("True", "True"),
        ("no", "no"),
        ("on", "on"),
        ("yes", "yes"),
        ("1:30", "1:30"),
        ("2026-11-21", "2026-11-21"),
        ("0x1F", "0x1F"),
        ("1_000", "1_000"),
        ("1e", "1e"),
        ("'1'", "1"),
        ("!!str 1", "1"),
        ("!!float 1.5", 1.5),
        ("-.inf", float("-inf")),
        ("~", None),
        ("null", None),
        ("", None),
        ("9" * 400, float("inf")),
        ("[1, {a: b}]", [1, {"a": "b"}]),
    ],
)
def test_scalars(text, expected):
    assert value(text) == expected
    assert type(value(text)) is type(expected)


def test_nan_is_a_number():
    assert value(".nan") != value(".nan")


def test_aliases_stand_for_whole_values():
    source = parse_yaml("a: &x [1, 2]\nb: *x\n", "f")
    assert source.tree == {"a": [1, 2], "b": [1, 2]}
    assert source.place(("b", 1)) == Place("f", 1, 11)  # where the value is written


def test_places():
    source = parse_yaml("a:\n  b: [1,\n      two]\nc: {d: e}\n", "f")
    assert source.place(("a", "b", 1)) == Place("f", 3, 7)
    assert source.place(("a", "b", 1), key=True) == Place("f", 3, 7)
    assert source.place(("a", "b"), key=True) == Place("f", 2, 3)
    assert source.place(("c", "d")) == Place("f", 4, 8)
    assert source.place(("c",)) == Place("f", 4, 1), "a mapping stands where its key does"
    assert source.place(("c", "missing", "deeper")) == Place("f", 4, 1)
    assert source.place(()) == Place("f", 1, 1)


@pytest.mark.parametrize(
    ("text", "line", "column", "message"),
    [
        ("a: 1\nb: 2\na: 3", 3, 1, "given twice, first on line 1"),
        ("a: {x: 1, x: 2}", 1, 11, "given twice"),
        ("a:\n\tb: 1", 2, 1, "indent with spaces"),
        ("a: 1\nb: [1,\n  2\n", 2, 4, "close the bracket"),
        ("a: 'x", 1, 4, "quoted scalar"),
        ("a: b: c", 1, 5, "not valid YAML"),
        ("a: 1\n b: 2", 2, 3, "not valid YAML"),
        ("a: @b", 1, 4, "cannot start"),
        ("a: 1\n---\nb: 2", 2, 1, "more than one YAML document"),
        ("a: 1\nb\x00: 1", 2, 2, "U+0000"),
        ("a: *q", 1, 4, "undefined alias"),
        ("a: &x [*x]", 1, 4, "own parent"),
        ("a: &x {b: 1}\nc:\n  <<: *x", 3, 3, "merge keys"),
        ("? [1]\n: 3", 1, 3, "plain word"),
        ("a: !!python/object:os.system {}", 1, 4, "tag"),
        ("a: !!float abc", 1, 4, "tag"),
        ("a: !mine [1]", 1, 4, "tag"),
        ("[" * 5000, 1, 1, "nested too deeply"),
    ],
)
def test_what_is_refused(text, line, column, message):
    with pytest.raises(SpecError) as error:
        parse_yaml(text, "f")
    (problem,) = error.value.problems
    assert (problem.file, problem.line, problem.column) == ("f", line, column)
    assert message in problem.message


def test_all_duplicates_are_reported():
    with pytest.raises(SpecError) as error:
        parse_yaml("a: 1\na: 2\nb: {c: 1, c: 2}", "f")
    assert [(p.line, p.column, p.key) for p in error.value.problems] == [(2, 1, "a"), (3, 11, "b.c")]


def test_aliases_that_multiply_are_stopped():
    lines = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]" for k in range(1, 9)]
    with pytest.raises(SpecError, match="more than 100000 values"):
        parse_yaml("\n".join(lines), "f")


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
    assert source.place(("a",)) == Place(str(file), 1, 4)


def test_overrides_replace_values_and_their_places():
    overrides = ["a.b=[5, 1e1]", "a.c={d: no}", "new.deep.key=true", "a.c.d=4"]
    source = parse_yaml("a: {b: [1, 2, 3], c: 3}\n", "f", overrides)
    assert source.tree == {"a": {"b": [5, 10.0], "c": {"d": 4}}, "new": {"deep": {"key": True}}}
    assert source.place(("a", "b", 1)) == Place("--set", 1, 9)
    assert source.place(("a", "c", "d")) == Place("--set", 4, 7)
    assert source.place(("new", "deep")) == Place("--set", 3, 1)
    assert ("a", "b", 2) not in source.nodes, "places of what was replaced are gone"
    assert parse_yaml("a: {b: 1}", "f", ["a.b="]).tree == {"a": {"b": None}}
    assert parse_yaml("a: {b: 1}", "f", ["a=c: 1\nd: 2"]).tree == {"a": {"c": 1, "d": 2}}


def test_an_override_changes_one_of_two_places_that_an_alias_shares():
    assert parse_yaml("a: &x {b: 1}\nc: *x\n", "f", ["c.b=2"]).tree == {"a": {"b": 1}, "c": {"b": 2}}


@pytest.mark.parametrize(
    ("override", "column", "message"),
    [
        ("a.b", 1, "key.path=value"),
        ("=3", 1, "key.path=value"),
        ("a..b=3", 1, "key.path=value"),
        ("a.b.c=3", 1, "a.b is not a mapping"),
        ("a.b=[1", 5, "close the bracket"),
        ("estimators.on.poles=3", 1, "did you mean 'one'?"),
    ],
)
def test_overrides_that_lead_nowhere(override, column, message):
    with pytest.raises(SpecError) as error:
        parse_yaml("a: {b: 1}\nestimators: {one: {poles: 2}}", "f", ["a.b=2", override])
    (problem,) = error.value.problems
    assert (problem.file, problem.line, problem.column) == ("--set", 2, column)
    assert message in problem.message
