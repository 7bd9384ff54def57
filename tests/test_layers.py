"""No circular imports between modules of the package, by any kind of import statement."""

import ast
from pathlib import Path

import ctid_cli

ROOT = Path(ctid_cli.__file__).parent


def modules():
    """Return the text of every module by its name."""
    return {
        ".".join(path.relative_to(ROOT.parent).with_suffix("").parts).removesuffix(".__init__"): path.read_text("utf-8")
        for path in sorted(ROOT.rglob("*.py"))
    }


def imported(text, names):
    """Return the modules among the names that are imported anywhere in a text."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            inner = {f"{node.module}.{alias.name}" for alias in node.names} & names
            yield from inner or {node.module} & names


def circle(graph):
    """Return the names in a circle, with the first one at both ends; empty if there is none."""
    clear = set()

    def walk(name, path):
        if name in path:
            return [*path[path.index(name) :], name]
        if name in clear:
            return []
        found = next(filter(None, (walk(other, [*path, name]) for other in sorted(graph[name]))), [])
        clear.add(name)
        return found

    return next(filter(None, (walk(name, []) for name in sorted(graph))), [])


def test_no_modules_import_each_other_in_a_circle():
    texts = modules()
    graph = {name: set(imported(text, texts.keys())) - {name} for name, text in texts.items()}
    assert len(graph) > 150
    assert sum(map(len, graph.values())) > 600
    found = circle(graph)
    assert not found, " -> ".join(found)


def test_the_check_sees_every_kind_of_import():
    text = (
        "import a\nfrom b import x\nfrom b import c\nif TYPE_CHECKING:\n    from d import y\ndef f():\n    import e.g\n"
    )
    assert sorted(imported(text, {"a", "b", "b.c", "d", "e.g"})) == ["a", "b", "b.c", "d", "e.g"]
    assert circle({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == ["b", "c", "b"]
    assert circle({"a": {"b", "c"}, "b": {"c"}, "c": set()}) == []


def test_no_two_files_share_a_name():
    names = [path.name for path in ROOT.rglob("*.py") if path.name != "__init__.py"]
    assert sorted(names) == sorted(set(names))
