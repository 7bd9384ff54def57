"""The identity of results that custom code made: what it contains counts, and nothing else."""

from pathlib import Path

import pytest

from ctid_cli.custom_code import CustomCodeError, find_class
from ctid_cli.storage.identity import modules_behind, modules_of

PART = '''\
"""A noise."""
from dataclasses import dataclass
import numpy
from ctid_cli import simulate
from levels import LEVEL

@dataclass(frozen=True)
class Noise:
    """White."""
    def generate(self, output, rng):
        from shapes.flat import shape
        return LEVEL * shape(rng, output.size)
'''
FILES = {
    "part.py": PART,
    "levels.py": "LEVEL = 2.0\n",
    "shapes/__init__.py": "",
    "shapes/flat.py": "from . import edges\ndef shape(rng, n):\n    return edges.LOW + rng.random(n)\n",
    "shapes/edges.py": "LOW = 0.5\n",
    "unused.py": "A = 1\n",
}


def behind(folder: Path, **changed: str) -> dict[str, str]:
    for name, text in FILES.items():
        (folder / name).parent.mkdir(exist_ok=True, parents=True)
        (folder / name).write_text(changed.get(Path(name).stem, text), encoding="utf-8")
    options = find_class("./part.py:Noise", folder)()
    return modules_behind(modules_of(options))


def test_the_folder_and_the_words_do_not_matter(tmp_path: Path) -> None:
    first = behind(tmp_path)
    assert behind(tmp_path / "elsewhere") == first
    assert behind(tmp_path, part="# another word\n" + PART.replace("White.", "Very white."), unused="A = 2\n") == first
    assert sum(name.startswith("own ") for name in first) == 5
    # What of ctid it uses counts too.
    assert {"ctid_cli.filtering.simulate", "ctid_cli.models.transfer_function"} <= first.keys()


@pytest.mark.parametrize(
    ("module", "text"),
    [
        ("part", PART.replace("LEVEL *", "LEVEL +")),
        ("levels", "LEVEL = 3.0\n"),
        ("flat", FILES["shapes/flat.py"].replace("+", "-")),
        ("edges", "LOW = 0.25\n"),
    ],
)
def test_every_module_on_the_way_matters(module: str, text: str, tmp_path: Path) -> None:
    assert behind(tmp_path) != behind(tmp_path, **{module: text})


def test_data_files_that_a_module_names_matter(tmp_path: Path) -> None:
    def with_data(value: str, names: str = '["rates.csv"]') -> dict[str, str]:
        (tmp_path / "rates.csv").write_text(value)
        return behind(tmp_path, levels=f"LEVEL = 2.0\nFILES = {names}\n")

    first = with_data("1,2")
    assert with_data("1,2") == first
    assert with_data("1,3") != first
    with pytest.raises(
        CustomCodeError, match=r"no\.csv, which FILES in levels\.py names, cannot be read: No such file"
    ):
        with_data("1", '["no.csv"]')
    with pytest.raises(CustomCodeError, match=r"FILES in levels\.py must be a list of names"):
        with_data("1", "[name for name in ()]")


def test_a_module_that_python_imports_itself_counts_as_far_as_it_is_not_installed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "mine_for_test"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "noise.py").write_text(
        PART.replace("from levels", "from .levels").replace("shapes.flat", "numpy.random")
    )
    (package / "levels.py").write_text("LEVEL = 2.0\n")
    monkeypatch.syspath_prepend(tmp_path)
    options = find_class("mine_for_test.noise:Noise", tmp_path)()
    first = modules_behind(modules_of(options))
    (package / "levels.py").write_text("LEVEL = 2.5\n")
    second = modules_behind(modules_of(options))
    assert [sum(name.startswith("own ") for name in found) for found in (first, second)] == [3, 3]
    assert first != second
    # Without a readable source the bytes count.
    (package / "levels.py").write_bytes(b"\x00\x01")
    assert modules_behind(modules_of(options)) not in (first, second)
