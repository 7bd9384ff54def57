from __future__ import annotations

import ast
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from ctid_cli.running.plan import Plan, build_plan
from ctid_cli.specification.load import load_spec
from ctid_cli.storage import identity
from ctid_cli.storage.identity import (
    PATH,
    ROOT,
    Origin,
    are_mixed,
    code_version,
    gathered,
    modules_behind,
    modules_of,
    numeric_platform,
)
from ctid_cli.storage.provenance import git_commit

STORED = Path(__file__).parent / "stored"
PLANS = {name: build_plan(load_spec(STORED / name / "spec.yaml")) for name in ("system", "signal")}
COMPUTING = sorted(
    {
        name
        for plan in PLANS.values()
        for value in (plan.data_cells[0].source, *(cell.estimator for cell in plan.estimators))
        for name in modules_behind(modules_of(value))
    }
)


@pytest.fixture
def tree(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A copy of the sources that may be changed."""
    monkeypatch.setattr(identity, "_TREES", tmp_path / "trees.json")
    root = tmp_path / "ctid_cli"
    shutil.copytree(ROOT, root, ignore=shutil.ignore_patterns("__pycache__", "reporting", "cli"))
    identity._known_trees.cache_clear()
    yield root
    identity._known_trees.cache_clear()
    identity._tree.cache_clear()


def versions(plan: Plan, root: Path) -> dict[str, str]:
    identity._tree.cache_clear()
    return {
        cell.name: code_version(modules_of(plan.data_cells[0].source), modules_of(cell.estimator), root)
        for cell in plan.estimators
    }


def path_of(name: str, root: Path) -> Path:
    return root.joinpath(*name.split(".")[1:]).with_suffix(".py")


class Mutation(ast.NodeTransformer):
    """Changes the first number or operator; a module without either gets one more statement."""

    done = False

    def visit_Constant(self, node: ast.Constant) -> ast.AST:
        if not self.done and type(node.value) in (int, float):
            self.done = True
            return ast.Constant(2 * node.value + 1)
        return node

    def visit_BinOp(self, node: ast.BinOp) -> ast.AST:
        if not self.done and isinstance(node.op, ast.Mult):
            self.done, node.op = True, ast.Add()
        return self.generic_visit(node)


def mutated(source: str) -> str:
    tree, mutation = ast.parse(source), Mutation()
    tree = mutation.visit(tree)
    return ast.unparse(tree) + ("" if mutation.done else "\nADDED = 1\n")


def test_a_changed_number_or_operator_is_noticed_in_every_module_on_the_way(tree: Path) -> None:
    before = {name: versions(plan, tree) for name, plan in PLANS.items()}
    assert before == {name: versions(plan, ROOT) for name, plan in PLANS.items()}
    assert set(COMPUTING) >= {f"ctid_cli.simulation.{name}" for name in ("dataset", "frequency_runs")}
    for module in (*COMPUTING, *PATH):
        file = path_of(module, tree)
        text = file.read_text(encoding="utf-8")
        file.write_text(mutated(text), encoding="utf-8")
        after = {name: versions(plan, tree) for name, plan in PLANS.items()}
        # Every estimate goes through the modules of the path, and through those that its own classes stand on.
        for name, plan in PLANS.items():
            source = modules_behind(modules_of(plan.data_cells[0].source), tree)
            for cell in plan.estimators:
                concerned = module in {*PATH, *source, *modules_behind(modules_of(cell.estimator), tree)}
                assert (after[name][cell.name] != before[name][cell.name]) == concerned, (module, cell.name)
        file.write_text(text, encoding="utf-8")


def test_another_estimator_does_not_matter(tree: Path) -> None:
    before = {name: versions(plan, tree) for name, plan in PLANS.items()}
    for module in ("estimators.td_srivc", "estimators.delay_profile", "frequency.drem_gradient", "frequency.esprit"):
        file = path_of(f"ctid_cli.{module}", tree)
        file.write_text(mutated(file.read_text(encoding="utf-8")), encoding="utf-8")
    after = {name: versions(plan, tree) for name, plan in PLANS.items()}
    assert after["signal"] == before["signal"]
    assert after["system"]["fixed"] == before["system"]["fixed"]
    assert after["system"]["search"] != before["system"]["search"]
    # The data sets are the same for both.
    assert [after["system"][k].partition("-")[0] for k in ("search", "fixed")] == [
        before["system"]["search"].partition("-")[0]
    ] * 2


def test_one_more_kind_does_not_matter(tree: Path) -> None:
    before = {name: versions(plan, tree) for name, plan in PLANS.items()}
    file, line = path_of("ctid_cli.kinds", tree), '        "svf": "ctid_cli.estimators.svf:Svf",\n'
    text = file.read_text(encoding="utf-8")
    assert line in text
    more = line.replace("svf", "another").replace("Svf", "Another")
    file.write_text(text.replace(line, line + more), encoding="utf-8")
    path_of("ctid_cli.estimators.another", tree).write_text("class Another: ...\n", encoding="utf-8")
    assert {name: versions(plan, tree) for name, plan in PLANS.items()} == before


def test_words_do_not_matter(tree: Path) -> None:
    before = {name: versions(plan, tree) for name, plan in PLANS.items()}
    for file in tree.rglob("*.py"):
        text = file.read_text(encoding="utf-8")
        # Neither comments nor the places of line breaks survive this.
        changed = ast.unparse(ast.parse(text))
        file.write_text(changed.replace('"""', '"""In other words: ', 1) + "\n# a comment\n", encoding="utf-8")
    for module in ("errors", "text", "running.engine", "running.stopping", "storage.journal", "storage.sealed"):
        file = path_of(f"ctid_cli.{module}", tree)
        file.write_text(mutated(file.read_text(encoding="utf-8")), encoding="utf-8")
    assert {name: versions(plan, tree) for name, plan in PLANS.items()} == before


def test_the_text_of_an_exception_does_not_matter_but_its_condition_does() -> None:
    def digest(text: str) -> str:
        return ast.dump(identity._Reduced().visit(ast.parse(text)))

    plain = digest("def f(x):\n    if x < 0:\n        raise ValueError(f'{x} is negative')\n")
    assert digest("def f(x):\n    if x < 0:\n        raise ValueError(f'never {x} below 0')\n") == plain
    assert digest("def f(x):\n    if x < 1:\n        raise ValueError(f'{x} is negative')\n") != plain
    assert digest("def f(x):\n    'Docs.'\n    if x < 0:\n        raise ValueError(f'{x} is negative')\n") == plain
    assert digest("def f(x):\n    return 'a'\n") != digest("def f(x):\n    return 'b'\n")


def test_imports_for_type_checkers_are_not_followed() -> None:
    reduced = identity._Reduced()
    reduced.visit(ast.parse("if TYPE_CHECKING:\n    import a\nelse:\n    import b\ndef f():\n    from c import d\n"))
    assert reduced.imports == {"b", "c", "c.d"}


def test_versions_of_numerical_libraries_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    before = versions(PLANS["signal"], ROOT)
    monkeypatch.setattr(identity, "package_versions", lambda names: dict.fromkeys(names, "0"))
    assert versions(PLANS["signal"], ROOT) != before


def test_the_hash_is_the_same_with_and_without_what_was_kept(tree: Path) -> None:
    first = versions(PLANS["system"], tree)
    assert identity._TREES.exists()
    identity._known_trees.cache_clear()
    assert versions(PLANS["system"], tree) == first
    identity._TREES.write_text("damaged")
    identity._known_trees.cache_clear()
    assert versions(PLANS["system"], tree) == first


def test_origins_are_gathered_and_compared() -> None:
    old, new = Origin("data1-own1", "p", ()), Origin("data1-own2", "p", ())
    found = gathered([("b", new), ("a", old), ("a", old)])
    assert found == (old, new)
    assert [origin.estimators for origin in found] == [("a",), ("b",)]
    assert not are_mixed(found)
    assert are_mixed(gathered([("a", old), ("a", new)]))
    assert are_mixed(gathered([("a", old), ("b", Origin("data2-own2", "p", ()))]))
    assert are_mixed(gathered([("a", old), ("b", Origin("data1-own2", "q", ()))]))
    # Of results that were stored before it was noted, it is not known which estimators they belong to.
    assert are_mixed([Origin("c1", "p", ()), Origin("c2", "p", ())])


def test_numeric_platform_follows_the_kernels_in_use() -> None:
    script = "from ctid_cli.storage.identity import numeric_platform; print(numeric_platform())"
    environment = {**os.environ, "OPENBLAS_CORETYPE": "Nehalem", "PYTHONPATH": str(Path(__file__).parents[2])}
    other = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True)
    here = numeric_platform()
    assert "; numba " in here
    assert f"python {sys.version_info.major}.{sys.version_info.minor}" in here
    # Where OpenBLAS was built for a single processor there is nothing to choose.
    if "Nehalem" in other.stdout:
        assert other.stdout.strip() != here
    else:
        assert "unknown" not in here


def test_the_commit_is_that_of_the_checkout_itself(tmp_path: Path) -> None:
    assert git_commit(tmp_path) is None
    git = ["git", "-C", str(tmp_path), "-c", "user.name=one", "-c", "user.email=one@example.org"]
    subprocess.run([*git, "init", "-q"], check=True)
    assert git_commit(tmp_path) is None
    subprocess.run([*git, "commit", "-q", "--allow-empty", "-m", "first"], check=True)
    found = subprocess.run([*git, "rev-parse", "HEAD"], check=True, capture_output=True, text=True)
    assert git_commit(tmp_path) == found.stdout.strip()
    # A folder in it is no checkout, and one without git tells nothing.
    (tmp_path / "inside").mkdir()
    assert git_commit(tmp_path / "inside") is None
