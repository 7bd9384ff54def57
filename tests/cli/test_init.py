"""What `ctid init` writes is right, runs, and never replaces what is there."""

import re
from importlib import resources

import pytest

from ctid_cli.cli.init_command import TEMPLATES
from ctid_cli.specification.load import load_spec


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_every_template_is_written_and_nothing_else(ctid, here):
    said = ctid("init").stdout
    files = {name for _, names in TEMPLATES.values() for name in names}
    assert {path.name for path in here.iterdir()} == files
    assert {path.name for path in (resources.files("ctid_cli") / "templates").iterdir()} - {"__pycache__"} == files
    assert all(names[0] in said for _, names in TEMPLATES.values())
    assert said.endswith("next: ctid run open-loop.yaml, then ctid table open-loop\n")


def test_one_kind(ctid, here):
    ctid("init", "measured")
    assert sorted(path.name for path in here.iterdir()) == ["measured-example.csv", "measured.yaml"]
    assert (
        "there is no kind 'mesured'; did you mean 'measured'? Kinds: open-loop"
        in ctid("init", "mesured", code=2).stderr
    )


def test_nothing_is_overwritten_without_force(ctid, here):
    (here / "modes.yaml").write_text("mine")
    said = ctid("init", "open-loop", "modes", code=3).stderr
    assert "modes.yaml is here already, so that nothing was written" in said
    assert [(path.name, path.read_text()) for path in here.iterdir()] == [("modes.yaml", "mine")]
    ctid("init", "modes", "--force")
    assert (here / "modes.yaml").read_text().startswith("# A sum of submodels")


@pytest.mark.usefixtures("without_workers")
def test_the_templates_are_valid_and_run(ctid, here):
    ctid("init")
    files = [names[0] for _, names in TEMPLATES.values()]
    assert re.findall(r"^(\S+): ok, (\S+): ", ctid("validate", *files).stdout, re.MULTILINE) == [
        (f"{kind}.yaml", kind) for kind in TEMPLATES
    ]
    for file in files:
        # What is unwise in them is there on purpose.
        assert all("ignores_the_loop: ignores the loop" in warning for warning in load_spec(here / file).warnings)
    ctid("run", *files, "--runs", 1, "--quiet")
    for kind in TEMPLATES:
        assert ctid("table", kind).stdout.startswith(kind)
        assert '"FAILED"' not in ctid("export", kind, "--format", "json").stdout


@pytest.mark.parametrize("kind", TEMPLATES)
def test_sections_are_explained_by_commands_that_exist(kind):
    """Every section has comments, and every command that is named exists."""
    from ctid_cli.cli.main import app

    text = (resources.files("ctid_cli") / "templates" / TEMPLATES[kind][1][0]).read_text(encoding="utf-8")
    bare = [line for line in text.split("\n\n") if re.search(r"^\w", line, re.MULTILINE) and "#" not in line]
    assert bare == []
    commands = {command.callback.__name__ for command in app.registered_commands}
    named = set(re.findall(r"ctid (\w+)", text.replace("of ctid", "")))
    assert named <= commands
    assert {"validate", "run", "schema"} <= named
    assert max(map(len, text.splitlines())) <= 120
