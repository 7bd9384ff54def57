"""The files of `ctid init` are valid, explained, can be run, and never replace existing ones."""

import re
from importlib import resources

import pytest
import typer

from ctid_cli.cli.experiment_commands import TEMPLATES
from ctid_cli.cli.main import app
from ctid_cli.running.trial import load_tried


@pytest.mark.slow
@pytest.mark.usefixtures("without_workers")
def test_the_templates_are_valid_and_run(ctid, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "modes.yaml").write_text("mine")
    ctid("init", code=3)
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("modes.yaml", "mine")]
    ctid("init --force")
    written = {name for _, names in TEMPLATES.values() for name in names}
    assert {path.name for path in tmp_path.iterdir()} == written
    assert {path.name for path in (resources.files("ctid_cli") / "templates").iterdir()} - {"__pycache__"} == written
    files = [names[0] for _, names in TEMPLATES.values()]
    for file in files:
        # One estimator ignores the loop on purpose.
        assert all("ignores_the_loop: is biased" in warning for warning in load_tried(tmp_path / file).warnings)
    ctid("run --runs 1 --quiet", *files)
    for kind in TEMPLATES:
        assert ctid(f"table {kind}").stdout.startswith(kind)
        assert '"FAILED"' not in ctid(f"export {kind} --json").stdout


@pytest.mark.parametrize("kind", TEMPLATES)
def test_sections_are_explained_by_commands_that_exist(kind):
    text = (resources.files("ctid_cli") / "templates" / TEMPLATES[kind][1][0]).read_text(encoding="utf-8")
    bare = [part for part in text.split("\n\n") if re.search(r"^\w", part, re.MULTILINE) and "#" not in part]
    assert bare == []
    named = set(re.findall(r"ctid (\w+)", text.replace("of ctid", "")))
    assert {"validate", "run", "schema"} <= named <= set(typer.main.get_group(app).commands)
    assert max(map(len, text.splitlines())) <= 120
