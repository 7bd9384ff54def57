"""The layers in docs/architecture.md are those that the import contract enforces."""

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def test_the_listed_layers_are_the_import_contract():
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    block = re.search(r"^```text\n(.*?)^```", text, re.DOTALL | re.MULTILINE).group(1)
    shown = [re.findall(r"\w+", re.split(r"\s{2,}", line)[0]) for line in block.splitlines()]
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    (contract,) = [c for c in settings["tool"]["importlinter"]["contracts"] if c["type"] == "layers"]
    assert shown == [re.findall(r"\w+", layer) for layer in contract["layers"]]
    assert contract["exhaustive"]


def test_every_layer_exists():
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    (contract,) = [c for c in settings["tool"]["importlinter"]["contracts"] if c["type"] == "layers"]
    names = {name for layer in contract["layers"] for name in re.findall(r"\w+", layer)}
    package = ROOT / "ctid_cli"
    assert names == {p.stem for p in package.iterdir() if p.suffix == ".py" or (p / "__init__.py").exists()} - {
        "__init__"
    }
