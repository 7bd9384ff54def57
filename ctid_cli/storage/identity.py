"""The identity of a result besides its specification: the code that it came from, and the machine's arithmetic.

Estimates are only put side by side when both agree. The *code version* of an estimate is a hash of the syntax trees,
without docstrings, comments and the texts of exceptions, of all modules on its way from a specification to a stored
number, and of the versions of the numerical libraries. It has two halves: the data set and what is stored of a fit,
then the estimator. The *numeric platform* covers what makes the same code give other last bits: the kernels that
OpenBLAS and NumPy choose for the processor, the processor that Numba compiles for, and the Python version.

Which modules those are follows from the import statements, wherever they stand, of the modules that define the classes
in use. Only imports from `COMPUTING_FLOORS` are followed: what lies above them plans, reports and stores; and those of
components of one's own, as far as they are neither installed nor part of Python. The modules
there that turn a specification into options, and options into data sets and estimates, are named in `PATH`.
"""

import ast
import ctypes
import dataclasses
import hashlib
import json
import os
import platform
import sys
from collections import defaultdict
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache
from importlib import metadata
from pathlib import Path
from typing import Any, Self, TypeGuard

from ctid_cli import own_code
from ctid_cli.canonical import content_hash

ROOT = Path(__file__).resolve().parents[1]
#: Parts of the package whose sources decide what is computed.
COMPUTING_FLOORS = {"arrays", "signals", "models", "filtering"}
COMPUTING_FLOORS |= {"inference", "estimation", "estimators", "frequency", "simulation"}
#: Modules of other floors that every estimate goes through.
PATH = (
    *("ctid_cli.specification.system_sections", "ctid_cli.specification.loop_section"),
    *("ctid_cli.specification.signal_sections", "ctid_cli.specification.start_sections"),
    *("ctid_cli.specification.option_sections", "ctid_cli.specification.start_points"),
    *("ctid_cli.running.plan", "ctid_cli.running.job", "ctid_cli.canonical"),
)
#: Libraries whose version decides what is computed.
NUMERICAL_LIBRARIES = ("numpy", "scipy", "numba")
#: Libraries whose version is worth knowing.
OTHER_LIBRARIES = ("pandas", "h5py", "joblib", "pydantic", "pyyaml")

_CORE_NAME_FUNCTIONS = (
    "scipy_openblas_get_corename64_",
    "scipy_openblas_get_corename",
    "openblas_get_corename64_",
    "openblas_get_corename",
)


@dataclass(frozen=True, order=True)
class Origin:
    """Where estimates come from."""

    code_version: str
    platform: str
    packages: tuple[tuple[str, str], ...]
    #: Hashes of the estimators whose estimates come from here; empty if not known.
    estimators: tuple[str, ...] = field(default=(), compare=False)

    @property
    def shared(self) -> tuple[Any, ...]:
        """What all estimates on the same data must have in common, whichever estimator made them."""
        return self.code_version.partition("-")[0], self.platform, self.packages

    @classmethod
    def of(cls, code_version: str, platform: str, packages: Iterable[Any], estimators: Iterable[str] = ()) -> Self:
        """An origin from plain data."""
        return cls(code_version, platform, tuple((name, version) for name, version in packages), tuple(estimators))


def gathered(pairs: Iterable[tuple[str, Origin]]) -> tuple[Origin, ...]:
    """The origins of estimates, each with the hashes of the estimators that it stands for."""
    found: dict[Origin, set[str]] = defaultdict(set)
    for estimator, origin in pairs:
        found[origin].add(estimator)
    return tuple(replace(origin, estimators=tuple(sorted(names))) for origin, names in sorted(found.items()))


def are_mixed(origins: Iterable[Origin]) -> bool:
    """Whether data sets, or the estimates of any one estimator, come from several versions of the code or platforms."""
    origins = tuple(origins)
    named = [name for origin in origins for name in origin.estimators or ("",)]
    return len({origin.shared for origin in origins}) > 1 or len(set(named)) < len(named)


def origin_of(source: Any, estimator: Any) -> Origin:
    """Where estimates computed by this process and its workers come from."""
    packages = (("python", platform.python_version()), *package_versions(NUMERICAL_LIBRARIES).items())
    return Origin(code_version(modules_of(source), modules_of(estimator)), numeric_platform(), packages)


def code_version(data: Iterable[str], estimator: Iterable[str], root: Path = ROOT) -> str:
    """Hashes of what makes data sets and stored results, and of what makes estimates, from the modules of both."""
    path = {name: _tree(name, root)[0] for name in PATH}
    halves = (path | modules_behind(data, root), modules_behind(estimator, root))
    versions = package_versions(NUMERICAL_LIBRARIES)
    return "-".join(content_hash([versions, half])[:12] for half in halves)


def modules_behind(names: Iterable[str], root: Path = ROOT) -> dict[str, str]:
    """Hash of the syntax tree of some modules and of every computing module that they import, directly or not."""
    found: dict[str, str] = {}
    own: dict[str, str] = {}
    waiting = list(names)
    while waiting:
        name = waiting.pop()
        if name in found or name in own:
            continue
        source = own_code.source_of(name)
        if source is None:
            found[name], imports = _tree(name, root)
        else:
            own[name], imports = _own_tree(source, name, root)
        waiting += imports
    # What a module of one's own contains matters, not what it is called.
    return found | {f"own {digest}": digest for digest in own.values()}


def modules_of(value: Any) -> set[str]:
    """The modules of the classes that options and their fields have."""
    parts = [getattr(value, part.name) for part in dataclasses.fields(value)]
    return {type(value).__module__}.union(*(modules_of(part) for part in parts if dataclasses.is_dataclass(part)))


def _own_tree(source: own_code.Source, name: str, root: Path) -> tuple[str, list[str]]:
    """The same as `_tree` of a module of one's own; one without a readable source counts by its bytes."""
    try:
        digest = hashlib.sha256(ast.dump(_Reduced().visit(ast.parse(source.content))).encode()).hexdigest()
    except (SyntaxError, ValueError):
        return hashlib.sha256(source.content).hexdigest(), []
    if source.data:
        digest = content_hash([digest, source.data])
    imports = []
    for other in sorted(own_code.imports_of(source, name)):
        package, _, attribute = other.rpartition(".")
        # Names that the package gives away are those of a module further down.
        module = getattr(sys.modules[package], attribute, None) if package == "ctid_cli" else None
        imports.append(getattr(module, "__module__", other))
    computing = [other for other in imports if _is_computing(other) and _file_of(other, root).is_file()]
    return digest, computing + [other for other in imports if own_code.source_of(other) is not None]


def _is_computing(name: str) -> bool:
    return name.startswith("ctid_cli.") and name.split(".")[1] in COMPUTING_FLOORS


def _file_of(name: str, root: Path) -> Path:
    package, *parts = name.split(".")
    # A class from elsewhere is read as far as its own module.
    return root.joinpath(*parts).with_suffix(".py") if package == "ctid_cli" else Path(str(sys.modules[name].__file__))


@cache
def _tree(name: str, root: Path) -> tuple[str, list[str]]:
    """Hash of the syntax tree of a module, and the computing modules that it imports."""
    known = _known_trees()
    source = _file_of(name, root).read_bytes()
    # What the hash is made by belongs to its key.
    key = hashlib.sha256(b"".join((sys.version.encode(), Path(__file__).read_bytes(), source))).hexdigest()
    if key not in known:
        reduced = _Reduced()
        tree = reduced.visit(ast.parse(source))
        known[key] = hashlib.sha256(ast.dump(tree).encode()).hexdigest(), sorted(reduced.imports)
        with suppress(OSError):
            _TREES.parent.mkdir(exist_ok=True)
            temporary = _TREES.with_suffix(f".{os.getpid()}")
            temporary.write_text(json.dumps(known), encoding="utf-8")
            temporary.replace(_TREES)
    digest, imports = known[key]
    # What is imported may be a name in a module instead.
    return digest, [name for name in imports if _is_computing(name) and _file_of(name, root).is_file()]


class _Reduced(ast.NodeTransformer):
    """A tree without docstrings and the texts of exceptions; the imports in it that take effect are noted."""

    def __init__(self) -> None:
        self.imports: set[str] = set()

    def generic_visit(self, node: ast.AST) -> ast.AST:
        body = getattr(node, "body", None)
        if isinstance(body, list) and body and isinstance(body[0], ast.Expr) and _is_text(body[0].value):
            del body[0]
        return super().generic_visit(node)

    def visit_Raise(self, node: ast.Raise) -> ast.AST:
        for part in ast.walk(node):
            if isinstance(part, ast.JoinedStr):
                part.values = [value for value in part.values if not _is_text(value)]
            elif _is_text(part):
                part.value = ""
        return node

    def visit_If(self, node: ast.If) -> ast.AST:
        if isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
            node.body = []
        return self.generic_visit(node)

    def visit_Import(self, node: ast.Import) -> ast.AST:
        self.imports |= {alias.name for alias in node.names}
        return node

    def visit_ImportFrom(self, node: ast.ImportFrom) -> ast.AST:
        self.imports |= {str(node.module), *(f"{node.module}.{alias.name}" for alias in node.names)}
        return node


def _is_text(node: ast.AST) -> TypeGuard[ast.Constant]:
    return isinstance(node, ast.Constant) and isinstance(node.value, str)


#: Hashes and imports by what they were made from, because walking through a tree takes its time.
_TREES = ROOT / "__pycache__" / "syntax_trees.json"


@lru_cache(maxsize=1)
def _known_trees() -> dict[str, Any]:
    with suppress(OSError, ValueError):
        return dict(json.loads(_TREES.read_text(encoding="utf-8")))
    return {}


def package_versions(names: tuple[str, ...] = NUMERICAL_LIBRARIES + OTHER_LIBRARIES) -> dict[str, str]:
    """Versions of installed packages."""
    return {name: _version(name) for name in names}


@cache
def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "missing"


@lru_cache(maxsize=1)
def numeric_platform() -> str:
    """What decides the last bits of floating-point results on this machine."""
    import numpy as np

    # stubs leave the modes of show_config untyped
    simd = np.show_config(mode="dicts")["SIMD Extensions"]  # type: ignore[index,call-overload,unused-ignore]
    features = "+".join([*simd["baseline"], *simd.get("found", [])])
    blas = "/".join(_openblas_kernels()) or "unknown"
    python = f"{sys.version_info.major}.{sys.version_info.minor}"
    kernels = f"blas {blas}; simd {features}; numba {_numba_target()}"
    return f"{sys.platform} {platform.machine()}; python {python}; {kernels}"


def _numba_target() -> str:
    """The processor that Numba compiles for, and a hash of what it may use of it."""
    from llvmlite import binding  # type: ignore[import-untyped,unused-ignore]

    processor = os.environ.get("NUMBA_CPU_NAME") or binding.get_host_cpu_name()
    features = os.environ.get("NUMBA_CPU_FEATURES") or binding.get_host_cpu_features().flatten()
    return f"{processor}/{content_hash(features)[:8]}"


def _openblas_kernels() -> Iterator[str]:
    import numpy as np
    import scipy

    for package in (np, scipy):
        root = Path(str(package.__file__)).parent
        for folder in (root.parent / f"{package.__name__}.libs", root / ".dylibs"):
            for file in sorted(folder.glob("*openblas*")):
                with suppress(OSError):
                    library = ctypes.CDLL(str(file))
                    for name in [name for name in _CORE_NAME_FUNCTIONS if hasattr(library, name)][:1]:
                        function = getattr(library, name)
                        function.restype = ctypes.c_char_p
                        yield (function() or b"unknown").decode("ascii", "replace")
