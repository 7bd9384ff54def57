"""Messages about specifications, word for word and with places: errors and warnings (`mistakes.yaml`)."""

from pathlib import Path

import pytest
import yaml

from ctid_cli.errors import SpecError
from ctid_cli.running import trial
from tests.specification.written import CUSTOM_PARTS, RECORD, changed, load

HERE = Path(__file__).parent
CASES = {
    f"{base}: {case['name']}": (base, case)
    for base, cases in yaml.safe_load((HERE / "mistakes.yaml").read_text(encoding="utf-8")).items()
    for case in cases
}


def said(folder, base, case):
    """Return the messages about a case: a file of this folder, or a text, with changes and overrides."""
    files = {"parts.py": CUSTOM_PARTS, "gains.py": "GAIN = 2.0\n", "record.csv": RECORD} | case.get("files", {})
    for file, old, new in case.get("code", ()):
        files[file] = changed(files[file], (old, new))
    for file, content in files.items():
        if content is not None:
            (folder / file).write_text(content, encoding="utf-8")
    text = case["text"] if base == "other" else (HERE / f"{base}.yaml").read_text(encoding="utf-8")
    try:
        spec = load(folder, changed(text, *case.get("change", ())), *case.get("set", ()), allow_code=True)
        found = {"warns": list(spec.warnings)}
    except SpecError as error:
        found = {"says": [str(problem) for problem in error.problems]}
    names = (f"{folder}/spec.yaml:", f"{folder}/")
    return {kind: [line.replace(names[0], "").replace(names[1], "") for line in found[kind]] for kind in found}


@pytest.mark.parametrize("name", CASES)
def test_messages(tmp_path, name, monkeypatch):
    # In this process: components that end their process are tested elsewhere.
    monkeypatch.setattr(trial, "call_alone", lambda folder, function, *given: (function(*given), "", 0.0))
    base, case = CASES[name]
    assert said(tmp_path, base, case) == {kind: case[kind] for kind in ("says", "warns") if kind in case}
