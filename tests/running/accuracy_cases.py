"""Experiments with a theory of their accuracy, and some without."""

from pathlib import Path

import yaml

HERE = Path(__file__).parents[1] / "cli"
CASES = yaml.safe_load((HERE / "accuracy.yaml").read_text(encoding="utf-8"))


def specification(case, folder):
    """Write the file of a case: the simulation examples of Gonzalez et al., or a single mode, with changes."""
    content = (HERE / "specifications" / f"{CASES[case]['of']}.yaml").read_text(encoding="utf-8")
    for old, new in CASES[case].get("change", ()):
        assert content.count(old) == 1
        content = content.replace(old, new)
    (folder / "spec.yaml").write_text(content, encoding="utf-8")
    return folder / "spec.yaml"
