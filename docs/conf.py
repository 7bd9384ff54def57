"""Sphinx settings; the reference pages are made from the commands, the specification and the public names."""

import re
import sys
from importlib import metadata
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

project = "ctid"
author = copyright = "the ctid developers"
version = release = metadata.version("ctid")
extensions = ["myst_parser", "numpydoc", "sphinx.ext.autodoc", "sphinx.ext.mathjax"]
exclude_patterns = ["examples"]
html_theme = "pydata_sphinx_theme"
html_theme_options = {
    "navbar_center": [],
    "navigation_with_keys": False,
    "secondary_sidebar_items": ["page-toc"],
    "show_prev_next": False,
}
html_sidebars = {"**": ["globaltoc"]}
html_show_sourcelink = False
myst_heading_anchors = 4
myst_enable_extensions = ["dollarmath"]
numpydoc_show_class_members = False
autodoc_member_order = "bysource"
autodoc_typehints = "none"


def commands() -> str:
    """Return a section for every command, with its help text."""
    import typer
    from typer.testing import CliRunner

    from ctid_cli.cli.main import app

    runner = CliRunner(env={"COLUMNS": "100", "NO_COLOR": "1", "TERM": "dumb"})
    names = list(typer.main.get_command(app).commands)  # type: ignore[attr-defined]
    texts = {name: runner.invoke(app, [name, "--help"]).stdout for name in names}
    return "# Commands\n\n" + "\n".join(
        f"## `ctid {name}`\n\n```text\n{text.strip()}\n```\n" for name, text in texts.items()
    )


def keys() -> str:
    """Return a section for every key of a specification."""
    from ctid_cli.specification.load import json_schema
    from ctid_cli.specification.reference import reference_text

    sections = json_schema()["properties"]
    return "# Keys of a specification\n\n" + "\n".join(
        f"## `{name}`\n\n```text\n{reference_text(name)}\n```\n" for name in sections
    )


def names() -> str:
    """Return the public names by the topics of ``__init__.pyi``, each with its docstring."""
    import inspect

    import ctid_cli

    lines = ["# Python interface", ""]
    for line in (HERE.parent / "ctid_cli" / "__init__.pyi").read_text(encoding="utf-8").splitlines():
        if line.startswith("# ") and "ruff" not in line and "internal" not in line:
            lines += [f"## {line[2:]}", ""]
        for name in re.findall(r" as (\w+)", line.partition("#")[0]):
            found = getattr(ctid_cli, name)
            kind = "class" if inspect.isclass(found) else "function" if callable(found) else "data"
            members = "\n   :members:" if kind == "class" else ""
            lines += [f"```{{eval-rst}}\n.. auto{kind}:: ctid_cli.{name}{members}\n```", ""]
    return "\n".join(lines)


def write_reference(app: object) -> None:
    """Write the generated pages before Sphinx reads the sources."""
    folder = HERE / "reference"
    folder.mkdir(exist_ok=True)
    for name, text in {"commands": commands(), "yaml": keys(), "python": names()}.items():
        (folder / f"{name}.md").write_text(text, encoding="utf-8")


def name_repository_files(app: object, page: str, source: list[str]) -> None:
    """Replace links to folders, and to pages outside ``docs``, by the path in the repository."""

    def named(link: re.Match[str]) -> str:
        path = (HERE / link[2].partition("#")[0]).resolve()
        outside = path.suffix == ".md" and path.parent != HERE
        inside = f"{link[1]} (`{path.relative_to(HERE.parent)}`)"
        return inside if path.exists() and (outside or path.is_dir()) else link[0]

    if "/" not in page:
        source[0] = re.sub(r"\[([^]]+)\]\(([\w./-]+(?:#[\w-]+)?)\)", named, source[0])


def setup(app: object) -> None:
    """Register the generated pages."""
    app.connect("builder-inited", write_reference)  # type: ignore[attr-defined]
    app.connect("source-read", name_repository_files)  # type: ignore[attr-defined]
