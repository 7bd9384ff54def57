"""What is said of specifications, word for word and with the place: mistakes, and what is unwise (`mistakes.yaml`)."""

from pathlib import Path

import pytest
import yaml

from ctid_cli.errors import SpecError
from tests.specification.written import CUSTOM_PARTS, RECORD, changed, load

HERE = Path(__file__).parent
CASES = {
    f"{base}: {case['name']}": (base, case)
    for base, cases in yaml.safe_load((HERE / "mistakes.yaml").read_text(encoding="utf-8")).items()
    for case in cases
}


@pytest.mark.parametrize("name", CASES)
def test_what_is_said_and_nothing_else(tmp_path, name):
    base, case = CASES[name]
    files = {"parts.py": CUSTOM_PARTS, "gains.py": "GAIN = 2.0\n", "record.csv": RECORD}
    for file, old, new in case.get("code", ()):
        files[file] = changed(files[file], (old, new))
    for file, content in files.items():
        (tmp_path / file).write_text(content, encoding="utf-8")
    text = changed((HERE / f"{base}.yaml").read_text(encoding="utf-8"), *case.get("change", ()))
    try:
        found = {"warns": list(load(tmp_path, text, *case.get("set", ()), allow_code=base == "custom").warnings)}
    except SpecError as error:
        found = {"says": [str(problem) for problem in error.problems]}
    said = {kind: [line.replace(f"{tmp_path}/spec.yaml:", "") for line in lines] for kind, lines in found.items()}
    expected = {kind: case[kind] for kind in ("says", "warns") if kind in case}
    assert {kind: [line.replace(f"{tmp_path}/", "") for line in lines] for kind, lines in said.items()} == expected
