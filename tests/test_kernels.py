"""Compiled functions are never outdated: they use nothing that their disk caches cannot see."""

import ast
import importlib
import importlib.util
import inspect
import os
import pkgutil
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path
from types import CodeType

import pytest

import ctid_cli
from ctid_cli.frequency import delay_kernels
from ctid_cli.frequency.flags import Flag

#: Packages that a kernel may use, as far as Numba compiles their functions into it.
PUBLIC = {"cmath", "math", "numba", "numpy"}
#: Names in annotations without effect on compiled code. A named tuple has one: the order of its fields.
PLAIN = {"Array", "BoolArray", "ComplexArray", "IndexArray", "IntArray", "NDArray", "NamedTuple"}


def kernels_of(module):
    """Return the compiled functions defined by a module."""
    found = (getattr(value, "py_func", None) for value in vars(module).values())
    return [function for function in found if inspect.isfunction(function) and function.__module__ == module.__name__]


def names_of(node):
    """Return all names in a part of a syntax tree."""
    return {part.id for part in ast.walk(node) if isinstance(part, ast.Name)}


@cache
def origins_of(module):
    """Return the packages of imported names, the names used in definitions of other names, and the annotations."""
    imported, made_of, annotations = {}, {}, {}
    for node in ast.walk(ast.parse(inspect.getsource(module))):
        if isinstance(node, ast.Import):
            imported |= {(alias.asname or alias.name.split(".")[0]): alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            imported |= {alias.asname or alias.name: str(node.module).split(".")[0] for alias in node.names}
        elif isinstance(node, ast.Assign | ast.AnnAssign | ast.AugAssign) and node.value is not None:
            for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
                for name in names_of(target):
                    made_of.setdefault(name, set()).update(names_of(node.value))
        elif isinstance(node, ast.ClassDef):
            made_of[node.name] = names_of(node)
        elif isinstance(node, ast.FunctionDef):
            parts = [argument.annotation for argument in node.args.args] + [node.returns]
            annotations[node.name] = set().union(*(names_of(part) for part in parts if part))
    return imported, made_of, annotations


def names_in(code):
    """Return the names that a function reads, including those of inner functions."""
    inner = (names_in(constant) for constant in code.co_consts if isinstance(constant, CodeType))
    return set(code.co_names).union(*inner)


def foreign_names(function, module):
    """Return the names from other files of the package that a function reads, directly or by a constant or type."""
    imported, made_of, annotations = origins_of(module)
    waiting = (names_in(function.__code__) & function.__globals__.keys()) | annotations[function.__name__]
    seen = set()
    while waiting:
        name = waiting.pop()
        seen.add(name)
        waiting |= (set() if name in imported else made_of.get(name, set())) - seen
    foreign = {name for name in seen if name in imported and imported[name] not in PUBLIC and name not in PLAIN}
    return foreign | set(function.__code__.co_freevars)


def test_kernels_read_nothing_of_other_files():
    """Numba compares its disk cache only with the file of the function, so kernels must not read other files."""
    names = [name for _, name, _ in pkgutil.walk_packages(ctid_cli.__path__, "ctid_cli.")]
    modules = [importlib.import_module(name) for name in names]
    found = {function: foreign_names(function, module) for module in modules for function in kernels_of(module)}
    assert len(found) > 50
    assert {f"{function.__module__}.{function.__name__}": names for function, names in found.items() if names} == {}


@pytest.mark.parametrize(
    ("source", "foreign"),
    [
        ("@njit\ndef kernel(x):\n    return x + OWN + np.pi", set()),
        ("@njit\ndef kernel(x: Array) -> float:\n    return inner(x[0])\n@njit\ndef inner(x):\n    return x", set()),
        ("@njit\ndef kernel(x):\n    return x + MOST_TONES", {"MOST_TONES"}),
        ("TWICE = 2 * MOST_TONES\nHALF = TWICE / 4\n@njit\ndef kernel(x):\n    return x + HALF", {"MOST_TONES"}),
        ("@njit\ndef kernel(x):\n    return [y + MOST_TONES for y in x]", {"MOST_TONES"}),
        ("@njit\ndef kernel(x):\n    return add_row(x, x)", {"add_row"}),
        ("@njit\ndef kernel(x):\n    return base.LARGEST_SAMPLE", {"base"}),
        ("@njit\ndef kernel(x: Clock):\n    return x.delay", {"Clock"}),
        ("class Pair(NamedTuple):\n    one: Clock\n@njit\ndef kernel(x: Pair):\n    return x.one", {"Clock"}),
        ("@njit\ndef kernel(x: Any):\n    return x", {"Any"}),
        (
            "def made(k):\n    @njit\n    def kernel(x):\n        return k\n    return kernel\nkernel = made(1)",
            {"k"},
        ),
    ],
)
def test_what_is_read_of_other_files_is_found(source, foreign, tmp_path):
    head = """
from typing import Any, NamedTuple
import numpy as np
from numba import njit
from ctid_cli.arrays import Array
from ctid_cli.frequency import base
from ctid_cli.frequency.base import MOST_TONES
from ctid_cli.frequency.delay_kernels import Clock, add_row
OWN = 3
"""
    (tmp_path / "case.py").write_text(head + source)
    spec = importlib.util.spec_from_file_location("case", tmp_path / "case.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["case"] = module
    try:
        spec.loader.exec_module(module)
        [function] = [function for function in kernels_of(module) if function.__name__ == "kernel"]
        assert foreign_names(function, module) == foreign
    finally:
        del sys.modules["case"]


def test_flags_of_kernels_are_those_of_estimates():
    bits = list(Flag)[:8]
    assert [getattr(delay_kernels, flag.name) for flag in bits] == bits


#: A kernel that calls another one in its file, which reads a constant.
SHORT_WORK = """
import sys
from ctid_cli.filtering import kernels
assert kernels.__file__.startswith(sys.argv[1]), kernels.__file__
print(kernels.step_weights(-0.5 + 0.3j, 1.0))
"""
CALLEE = ("0.5 + re * inner_re - im", "0.6 + re * inner_re - im")
CONSTANT = ("math.factorial(k + 4)", "math.factorial(k + 5)")


def copied_package(root):
    """Copy the package without compiled files."""
    shutil.copytree(Path(ctid_cli.__file__).parent, root / "ctid_cli", ignore=shutil.ignore_patterns("__pycache__"))
    return root / "ctid_cli" / "filtering"


def computed(root, home):
    """Return the results of the copy in a new process, with the caches of earlier ones."""
    environment = os.environ | {"PYTHONPATH": str(root), "HOME": str(home)}
    for name in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME"):
        environment.pop(name, None)
    command = [sys.executable, "-c", SHORT_WORK, str(root)]
    return subprocess.run(command, env=environment, cwd=root, capture_output=True, text=True, check=True).stdout


def replaced(file, old, new, *, same_stamp=False):
    """Edit a source; optionally without changing its size and time stamp, as an installer may, with new bytecode."""
    text, stat = file.read_text(), file.stat()
    assert text.count(old) == 1
    file.write_text(text.replace(old, new))
    if same_stamp:
        assert file.stat().st_size == stat.st_size
        os.utime(file, ns=(stat.st_atime_ns, stat.st_mtime_ns))
        for bytecode in (file.parent / "__pycache__").glob("*.pyc"):
            bytecode.unlink()


@pytest.mark.parametrize(
    ("place", "changes"),
    [
        ("edited in place", [CALLEE]),
        pytest.param("upgraded by an installer", [CONSTANT], marks=pytest.mark.slow),
        pytest.param("read-only", [CALLEE, CONSTANT], marks=pytest.mark.slow),
    ],
)
def test_changes_of_callees_and_constants_are_computed_with(place, changes, tmp_path):
    """After any change of a source, the next process uses it, without deleting caches."""
    folder, home = copied_package(tmp_path / "site-packages"), tmp_path / "home"
    if place == "read-only":
        # Permissions do not restrict root: a file at the path prevents the creation of the cache folder.
        for inner in {path.parent for path in (tmp_path / "site-packages").rglob("*.py")}:
            (inner / "__pycache__").touch()
    first = computed(tmp_path / "site-packages", home)
    assert list((home if place == "read-only" else folder).rglob("kernels.step_weights-*.nbi"))
    results = [first]
    for change in changes:
        replaced(folder / "kernels.py", *change, same_stamp=place == "upgraded by an installer")
        results.append(computed(tmp_path / "site-packages", home))
    assert len(set(results)) == 1 + len(changes)
