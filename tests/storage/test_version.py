from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from ctid_cli.storage.provenance import git_commit
from ctid_cli.storage.version import code_version, current_origin, numeric_platform


def make(root: Path, **sources: str) -> Path:
    for name, text in sources.items():
        file = root / name.replace("__", "/")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.with_suffix(".py").write_bytes(text.encode())
    return root


def test_code_version_follows_the_computing_sources_only(tmp_path: Path) -> None:
    base = make(tmp_path / "a", signals__noise="x = 1\n", estimators__srivc="y = 2\n", cli__main="z = 3\n")
    version = code_version(base)
    assert version == code_version(make(tmp_path / "b", signals__noise="x = 1\r\n", estimators__srivc="y = 2\n"))
    assert version != code_version(make(tmp_path / "c", signals__noise="x = 1\n", estimators__srivc="y = 3\n"))
    assert version != code_version(make(tmp_path / "d", signals__noise="x = 1\n", estimators__iv="y = 2\n"))
    make(base, estimators__new__file="")
    assert version != code_version(base)


def test_the_package_has_the_floors_that_are_hashed() -> None:
    assert current_origin().code_version != code_version(Path("/nonexistent"))
    assert [name for name, _ in current_origin().packages] == ["python", "numpy", "scipy", "numba"]


def test_numeric_platform_follows_the_kernels_in_use() -> None:
    script = "from ctid_cli.storage.version import numeric_platform; print(numeric_platform())"
    environment = {**os.environ, "OPENBLAS_CORETYPE": "Nehalem", "PYTHONPATH": str(Path(__file__).parents[2])}
    other = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True)
    here = numeric_platform()
    assert f"python {sys.version_info.major}.{sys.version_info.minor}" in here
    # Where OpenBLAS was built for a single processor there is nothing to choose.
    if "Nehalem" in other.stdout:
        assert other.stdout.strip() != here
    else:
        assert "unknown" not in here


def test_commit_is_read_without_git(tmp_path: Path) -> None:
    commit = "0123456789abcdef0123456789abcdef01234567"
    assert git_commit(tmp_path) is None
    git = tmp_path / ".git"
    (git / "refs" / "heads").mkdir(parents=True)
    (git / "HEAD").write_text("ref: refs/heads/main\n")
    assert git_commit(tmp_path) is None
    (git / "packed-refs").write_text(f"# pack-refs\n{commit} refs/heads/main\n")
    assert git_commit(tmp_path) == commit
    (git / "refs" / "heads" / "main").write_text("f" * 40 + "\n")
    assert git_commit(tmp_path) == "f" * 40
    (git / "HEAD").write_text(commit + "\n")
    assert git_commit(tmp_path) == commit
    tree = tmp_path / "worktree"
    (git / "worktrees" / "w").mkdir(parents=True)
    (git / "worktrees" / "w" / "HEAD").write_text("ref: refs/heads/main\n")
    (git / "worktrees" / "w" / "commondir").write_text("../..\n")
    tree.mkdir()
    (tree / ".git").write_text(f"gitdir: {git / 'worktrees' / 'w'}\n")
    assert git_commit(tree) == "f" * 40
