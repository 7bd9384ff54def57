"""What the README shows is what happens."""

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def block(language):
    return re.findall(rf"^```{language}\n(.*?)^```", README, re.DOTALL | re.MULTILINE)


def test_the_python_example_prints_what_is_shown():
    (example,) = block("python")
    shown = block("text")
    done = subprocess.run(
        [sys.executable, "-c", example], capture_output=True, text=True, check=True, cwd=ROOT, timeout=300
    )
    assert done.stdout in shown
    assert len(example.strip().splitlines()) <= 12


def test_the_specifications_are_valid(tmp_path):
    from ctid_cli.running.plan import build_plan
    from ctid_cli.specification.load import load_spec

    first, second = block("yaml")
    file = tmp_path / "my-first.yaml"
    file.write_text(first, encoding="utf-8")
    plan = build_plan(load_spec(file))
    assert plan.experiment == "my-first"
    assert plan.data_sets == 40
    file.write_text("experiment: sum\nmonte_carlo: {runs: 300, seed: 1}\n" + second, encoding="utf-8")
    plan = build_plan(load_spec(file))
    assert (plan.data_sets, len(plan.estimators)) == (15_000, 2)


def test_linked_files_exist():
    links = re.findall(r"\]\(([^)#:]+)\)", README)
    assert links
    for link in links:
        assert (ROOT / link).exists(), link


def test_named_configs_exist():
    names = set(re.findall(r"configs/[\w/]+\.yaml", README))
    assert "configs/quickstart.yaml" in names
    for name in names:
        assert (ROOT / name).is_file(), name
