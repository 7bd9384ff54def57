"""Valid specifications, and the messages, with line and column, about invalid ones."""

import copy
import hashlib
import json
import math
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from ctid_cli.canonical import canonical_json, content_hash
from ctid_cli.errors import DataError, SpecError
from ctid_cli.running.plan import build_plan
from ctid_cli.specification.load import json_schema, load_spec, spec_from_canonical
from tests.specification.written import (
    CLOSED_LOOP,
    CUSTOM,
    CUSTOM_PARTS,
    MEASURED,
    MEASURED_LOOP,
    OPEN_LOOP,
    RECORD,
    SIGNAL,
    SIMULATED,
    changed,
    load,
    problems,
)

CONFIGS = Path(__file__).resolve().parents[2] / "configs"


def test_canonical_form_fills_defaults_and_comes_back(tmp_path):
    spec = load(tmp_path, SIMULATED)
    canonical = spec.canonical()
    assert canonical["excitation"] == {"kind": "prbs", "stages": 10, "clock_period": 0.05, "amplitude": 1.0}
    assert canonical["noise"] == {"kind": "white", "snr_db": [5.0, 15.0], "standard_deviation": None, "variance": None}
    assert canonical["starts"] == {"initial_delay": [0.0, 3.0, {"uniform": [0.0, 9.0]}], "parameters": None}
    assert canonical["data"] is None
    assert spec.text == SIMULATED
    again = spec_from_canonical(json.loads(canonical_json(canonical)))
    assert again.canonical() == canonical
    assert spec_from_canonical(json.loads(again.text)).canonical() == canonical
    with pytest.raises(SpecError, match="did you mean 'noise'"):
        spec_from_canonical({**canonical, "nois": None})


def test_one_and_one_point_zero_are_the_same_number_and_minus_zero_is_zero(tmp_path):
    spec = load(tmp_path, SIMULATED)
    text = changed(SIMULATED, ("delay: 8.0", "delay: 8"), ("[2]", "[2.0e+0]"), ("[0, 3,", "[-0.0, 3.0,"))
    assert content_hash(load(tmp_path, text).canonical()) == content_hash(spec.canonical())


def reordered(node, draw):
    if isinstance(node, dict):
        keys = draw(st.permutations(list(node)))
        return {key: reordered(node[key], draw) for key in keys}
    return node


@given(st.data())
def test_the_hash_ignores_key_order_comments_and_layout(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("spec")
    tree = reordered(yaml.safe_load(SIMULATED), data.draw)
    text = yaml.safe_dump(tree, sort_keys=False, default_flow_style=data.draw(st.sampled_from([None, True, False])))
    if not text.startswith("{"):
        comment = "#" + data.draw(st.text("abc: {}[]#'", max_size=10)) + "\n"
        text = "".join(data.draw(st.sampled_from(["", comment, "\n"])) + line for line in text.splitlines(True))
    assert content_hash(load(folder, text).canonical()) == content_hash(load(folder, SIMULATED).canonical())


def test_hashes_are_what_they_were():
    """Hashes must never change: all earlier results would be unused."""
    assert canonical_json({"b": [1.0, 1e-3, None], "a": "é"}) == '{"a":"é","b":[1.0,0.001,null]}'
    assert content_hash({"b": [1.0, 1e-3, None], "a": "é"}) == "1700a7aeb6dfa5c8"
    with pytest.raises(ValueError, match="JSON compliant"):
        canonical_json([float("nan")])


BASES = [yaml.safe_load(text) for text in (SIMULATED, CLOSED_LOOP, SIGNAL, OPEN_LOOP, MEASURED, MEASURED_LOOP, CUSTOM)]
VALUES = [None, [], {}, -1, 0, 2, 0.5, 1e300, 1e-300, math.nan, math.inf, True, "", "x", [1, 1], [1, -2], {"kind": "x"}]
SECTIONS = [(name, section) for tree in BASES for name, section in tree.items()]


def places(node):
    """Yield every mapping or list in a tree with each of its keys."""
    for key, value in list(node.items() if isinstance(node, dict) else enumerate(node)):
        yield node, key
        if isinstance(value, dict | list):
            yield from places(value)


@settings(max_examples=20)
@given(st.data())
def test_whatever_is_wrong_ends_in_problems_with_their_places(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("spec")
    for name, text in (("record.csv", RECORD), ("parts.py", CUSTOM_PARTS), ("gains.py", "GAIN = 2.0")):
        (folder / name).write_text(text, encoding="utf-8")
    tree = copy.deepcopy(data.draw(st.sampled_from(BASES)))
    for _ in range(data.draw(st.integers(1, 4))):
        node, key = data.draw(st.sampled_from(list(places(tree)) or [(tree, "experiment")]))
        name, section = data.draw(st.sampled_from(SECTIONS))
        if data.draw(st.booleans()):
            node[key] = copy.deepcopy(data.draw(st.sampled_from(VALUES)))
        else:
            tree[name] = copy.deepcopy(section)
    found = []
    try:
        build_plan(load(folder, yaml.safe_dump(tree, sort_keys=False), allow_code=True))
    except SpecError as error:
        found = error.problems
    assert all(problem.line >= 1 and problem.column >= 1 and problem.message for problem in found)


# -- measured records and files ---------------------------------------------------------------------------------------


def test_content_hash_of_a_file_is_checked(tmp_path):
    (tmp_path / "record.csv").write_text(RECORD)
    pinned = changed(MEASURED, ("offset", f"sha256: {'0' * 64}, offset"))
    (problem,) = problems(tmp_path, pinned)
    assert (problem.line, problem.key) == (2, "data.sha256")
    good = load(tmp_path, MEASURED).data.sha256
    assert load(tmp_path, pinned.replace("0" * 64, good))


def test_a_file_of_instants(tmp_path):
    text = changed(SIMULATED, ("{kind: regular, interval: 0.05, samples: 4000}", "{kind: irregular, file: stamps.csv}"))
    stamps = np.round(np.cumsum(np.random.default_rng(0).uniform(0.1, 0.9, 300)), 3)
    for folder in (tmp_path, tmp_path / "elsewhere"):
        folder.mkdir(exist_ok=True)
        (folder / "stamps.csv").write_text("t\n" + "\n".join(map(str, stamps)) + "\n")
    cell = build_plan(load(tmp_path, text)).data_cells[0]
    record = cell.dataset(0).record
    assert record.t.tolist() == stamps.tolist()
    assert record.input.t[0] == stamps[0]
    assert "file" not in cell.content["sampling"], "the place of a file is no part of its identity"
    assert build_plan(load(tmp_path / "elsewhere", text)).data_cells[0].hash == cell.hash
    with (tmp_path / "stamps.csv").open("a") as file:
        file.write("500\n")
    assert build_plan(load(tmp_path, text)).data_cells[0].hash != cell.hash
    with pytest.raises(DataError, match="differs from that of the planned experiment"):
        cell.dataset(0)
    listed = f"{{kind: irregular, times: {stamps.tolist()}}}"
    text = changed(text, ("{kind: irregular, file: stamps.csv}", listed))
    np.testing.assert_array_equal(build_plan(load(tmp_path, text)).data_cells[0].dataset(0).record.y, record.y)


# -- shipped files ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("config", sorted(CONFIGS.rglob("*.yaml")), ids=lambda path: path.stem)
def test_shipped_configs(config):
    spec = load_spec(config)
    meant = ("sees the input at its samples only", "covariance: is for white noise")
    assert all(any(words in warning for words in meant) for warning in spec.warnings)
    schema = config.read_text(encoding="utf-8").splitlines()[0].removeprefix("# yaml-language-server: $schema=")
    assert (config.parent / schema).resolve() == CONFIGS / "ctid.schema.json"


def test_the_shipped_schema_is_current():
    assert json.loads((CONFIGS / "ctid.schema.json").read_text(encoding="utf-8")) == json_schema(), (
        "write it anew: ctid schema > configs/ctid.schema.json"
    )


def test_the_schema_knows_types_and_units():
    schema = json_schema()
    interval = schema["$defs"]["RegularSampling"]["properties"]["interval"]
    assert interval["description"] == "Sampling interval [s]."
    assert interval["oneOf"] == [{"type": "number"}, {"type": "array", "items": {"type": "number"}}]
    bounds = schema["$defs"]["TdSrivc"]["properties"]["delay_bounds"]
    assert (bounds["type"], bounds["minItems"], bounds["maxItems"]) == ("array", 2, 2)


def test_the_notice_names_the_shipped_record():
    content = (CONFIGS / "measured" / "buck_converter.csv").read_bytes()
    notice = (CONFIGS / "measured" / "NOTICE.md").read_text(encoding="utf-8")
    assert hashlib.sha256(content).hexdigest() in notice
    assert "Permission is hereby granted" in notice
