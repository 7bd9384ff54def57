"""A folder of stored estimates, made once and copied for each test, which may damage it."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.storage.made_results import plan_of, run_folder


@pytest.fixture(scope="session")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run_folder(plan_of(5).manifest(), tmp_path_factory.mktemp("stored") / "toys")


@pytest.fixture
def place(stored: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(stored, tmp_path / "results" / "toys"))
