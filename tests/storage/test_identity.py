from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

from ctid_cli.custom_code import find_class
from ctid_cli.storage import identity
from ctid_cli.storage.identity import (
    COMPUTING,
    ROOT,
    Origin,
    code_version,
    git_commit,
    modules_of,
    numeric_platform,
    origin_differences,
)


@pytest.fixture
def tree(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a package with a module in every computing folder, and in some others."""
    monkeypatch.setattr(identity, "_KEPT", tmp_path / "kept.json")
    for name in (*COMPUTING, "cli/main.py", "reporting/layout.py", "storage/journal.py", "errors.py"):
        assert (ROOT / name).exists()
        file = tmp_path / "package" / (name if name.endswith(".py") else f"{name}/inner/module.py")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text('"""A module."""\n\n\ndef half(x):\n    """Return half."""\n    return 0.5 * (x)\n')
    return tmp_path / "package"


def test_what_computes_counts_and_words_do_not(tree: Path) -> None:
    before = code_version((), tree)
    for file in tree.rglob("*.py"):
        # Comments and line breaks are lost here.
        changed = ast.unparse(ast.parse(file.read_text(encoding="utf-8")))
        file.write_text(changed.replace('"""', '"""In other words: ', 1) + "\n# a comment\n", encoding="utf-8")
    for name in ("cli/main.py", "reporting/layout.py", "storage/journal.py", "errors.py"):
        (tree / name).write_text("ADDED = 1\n")
    assert code_version((), tree) == before
    for name in COMPUTING:
        (file,) = [tree / name] if name.endswith(".py") else (tree / name).rglob("*.py")
        text = file.read_text()
        file.write_text(f"{text}\nADDED = 1\n")
        assert code_version((), tree) != before, name
        file.write_text(text)
    identity._KEPT.write_text("damaged")
    assert code_version((), tree) == code_version((), tree) == before, "kept or not"


def test_versions_of_numerical_libraries_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    before = code_version()
    monkeypatch.setattr(identity, "package_versions", lambda names: dict.fromkeys(names, "0"))
    assert code_version() != before


PART = '''\
"""A noise."""
from dataclasses import dataclass
import numpy
from levels import LEVEL

@dataclass(frozen=True)
class Noise:
    """White."""
    def generate(self, output, rng):
        return LEVEL * rng.random(output.size)
'''


def custom(folder: Path, part: str = PART, levels: str = "LEVEL = 2.0\n", rates: str = "1,2") -> str:
    folder.mkdir(exist_ok=True)
    for name, text in {"part.py": part, "levels.py": levels, "rates.csv": rates, "unused.py": rates}.items():
        (folder / name).write_text(text, encoding="utf-8")
    return code_version(modules_of(find_class("./part.py:Noise", folder)()))


def test_custom_components_count_with_all_that_they_import(tmp_path: Path) -> None:
    first = custom(tmp_path / "a")
    assert first != code_version()
    assert custom(tmp_path / "b", "# another word\n" + PART.replace("White.", "Very white."), rates="3") == first
    assert custom(tmp_path / "c", PART.replace("LEVEL *", "LEVEL +")) != first
    assert custom(tmp_path / "d", levels="LEVEL = 3.0\n") != first
    named = [custom(tmp_path / f"e{k}", levels='LEVEL = 2.0\nFILES = ["rates.csv"]\n', rates=f"{k}") for k in (1, 2)]
    assert len({first, *named}) == 3


def test_a_module_that_python_imports_itself_counts_if_it_is_not_installed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "mine_for_test"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "noise.py").write_text(PART.replace("from levels", "from .levels"))
    (package / "levels.py").write_text("LEVEL = 2.0\n")
    monkeypatch.syspath_prepend(tmp_path)
    options = find_class("mine_for_test.noise:Noise", tmp_path)()
    versions = [code_version(modules_of(options))]
    # Without a readable source the bytes are hashed.
    for content in (b"LEVEL = 2.5\n", b"\x00\x01"):
        (package / "levels.py").write_bytes(content)
        versions.append(code_version(modules_of(options)))
    assert len(set(versions)) == 3


def test_differences_of_origins_are_named() -> None:
    one = Origin("c", "p", (("numpy", "2"), ("numba", "1")))
    assert origin_differences(one, one, "then", "now") == ""
    found = origin_differences(one, Origin("d", "q", (("numpy", "3"), ("numba", "1"))), "then", "now")
    assert found == "code version c then, d now; numpy 2 then, 3 now; numeric platform 'p' then, 'q' now"


def test_numeric_platform_follows_the_kernels_in_use() -> None:
    script = "from ctid_cli.storage.identity import numeric_platform; print(numeric_platform())"
    environment = {**os.environ, "OPENBLAS_CORETYPE": "Nehalem", "PYTHONPATH": str(Path(__file__).parents[2])}
    other = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True)
    here = numeric_platform()
    assert f"python {sys.version_info.major}.{sys.version_info.minor}" in here
    # An OpenBLAS built for a single processor has no choice of kernels.
    assert other.stdout.strip() != here if "Nehalem" in other.stdout else "unknown" not in here


def test_the_commit_is_that_of_the_checkout_itself(tmp_path: Path) -> None:
    assert git_commit(tmp_path) is None
    git = ["git", "-C", str(tmp_path), "-c", "user.name=one", "-c", "user.email=one@example.org"]
    subprocess.run([*git, "init", "-q"], check=True)
    assert git_commit(tmp_path) is None
    subprocess.run([*git, "commit", "-q", "--allow-empty", "-m", "first"], check=True)
    found = subprocess.run([*git, "rev-parse", "HEAD"], check=True, capture_output=True, text=True)
    assert git_commit(tmp_path) == found.stdout.strip()
    # A folder inside it is not a checkout.
    (tmp_path / "inside").mkdir()
    assert git_commit(tmp_path / "inside") is None
