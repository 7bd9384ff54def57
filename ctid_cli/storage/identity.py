"""Origin of results: code version, numeric platform, and circumstances of a run.

Estimates are compared only if code and arithmetic agree. The *code version* is a hash of the syntax trees, without
docstrings and comments, of all computing layers and of the custom components of a plan, and of the versions of the
numerical libraries. The *numeric platform* is what changes the last bits of results of the same code: the kernels that
OpenBLAS and NumPy choose for the processor, the processor that Numba compiles for, and the Python version.
"""

import ast
import ctypes
import dataclasses
import hashlib
import json
import os
import platform
import subprocess
import sys
from collections.abc import Iterable, Iterator
from contextlib import suppress
from datetime import UTC, datetime
from functools import cache, lru_cache
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple, Self

from ctid_cli import custom_code
from ctid_cli.canonical import content_hash

ROOT = Path(__file__).resolve().parents[1]
#: Folders and modules of the package whose sources affect results.
COMPUTING = (
    *("arrays.py", "canonical.py", "signals", "models", "filtering", "inference", "estimation", "estimators"),
    *("frequency", "simulation", "specification", "running/plan.py", "running/job.py"),
)
#: Libraries whose versions affect results.
NUMERICAL_LIBRARIES = ("numpy", "scipy", "numba")
#: Libraries whose versions are recorded only.
OTHER_LIBRARIES = ("pandas", "h5py", "joblib", "pydantic", "pyyaml")
#: Cache of syntax tree hashes by source hash, because parsing takes seconds.
_KEPT = ROOT / "__pycache__" / "syntax_trees.json"

_CORE_NAME_FUNCTIONS = (
    "scipy_openblas_get_corename64_",
    "scipy_openblas_get_corename",
    "openblas_get_corename64_",
    "openblas_get_corename",
)


class Origin(NamedTuple):
    """Origin of estimates: code version and numeric platform."""

    code_version: str
    platform: str
    packages: tuple[tuple[str, str], ...]

    @classmethod
    def of(cls, code_version: str, platform: str, packages: Iterable[Any]) -> Self:
        """Return an origin from plain data."""
        return cls(code_version, platform, tuple((name, version) for name, version in packages))


def origin_of(*options: Any) -> Origin:
    """Return the origin of estimates that this process and its workers compute with the given options."""
    packages = (("python", platform.python_version()), *package_versions(NUMERICAL_LIBRARIES).items())
    return Origin(code_version(set().union(*map(modules_of, options))), numeric_platform(), packages)


def origin_differences(one: Origin, other: Origin, of_one: str, of_other: str) -> str:
    """Describe the differences of two origins in words; empty if they are equal."""
    left, right = dict(one.packages), dict(other.packages)
    pairs: list[tuple[str, str | None, str | None]] = [("code version", one.code_version, other.code_version)]
    pairs += [(name, left.get(name), right.get(name)) for name in left | right]
    pairs += [("numeric platform", repr(one.platform), repr(other.platform))]
    return "; ".join(f"{name} {mine} {of_one}, {its} {of_other}" for name, mine, its in pairs if mine != its)


def code_version(modules: Iterable[str] = (), root: Path = ROOT) -> str:
    """Return the hash of the computing layers, the numerical libraries, and the custom code among some modules."""
    custom = sorted(set(_custom_modules(modules).values()))
    return content_hash([package_versions(NUMERICAL_LIBRARIES), _layers_hash(root), custom])[:12]


def modules_of(value: Any) -> set[str]:
    """Return the modules of the classes of options and their fields."""
    fields = dataclasses.fields(value) if dataclasses.is_dataclass(value) else ()
    parts = [modules_of(getattr(value, part.name)) for part in fields]
    parts += [modules_of(item) for item in value] if isinstance(value, list | tuple) else []
    return {type(value).__module__}.union(*parts)


def _custom_modules(names: Iterable[str]) -> dict[str, str]:
    """Return hashes of the custom modules among the named ones, and of those that they import, directly or not."""
    found: dict[str, str] = {}
    waiting = list(names)
    while waiting:
        name = waiting.pop()
        if name in found or name.partition(".")[0] in sys.stdlib_module_names | {"ctid_cli"}:
            continue
        source = custom_code.source_of(name)
        if source is not None:
            try:
                tree = _without_docstrings(source.content)
            except (SyntaxError, ValueError):
                tree = hashlib.sha256(source.content).hexdigest()
            # The content of a module is hashed, not its name.
            found[name] = content_hash([tree, source.data])
            waiting += custom_code.imports_of(source, name)
    return found


def _layers_hash(root: Path) -> str:
    places = [root / name for name in COMPUTING]
    files = sorted(file for place in places for file in (place.rglob("*.py") if place.is_dir() else [place]))
    sources = [(file.relative_to(root).as_posix(), file.read_bytes()) for file in files]
    # The key depends on the hash function too.
    key = hashlib.sha256(repr((sys.version, Path(__file__).read_bytes(), sources)).encode()).hexdigest()
    with suppress(OSError, ValueError, KeyError, TypeError):
        return str(json.loads(_KEPT.read_text(encoding="utf-8"))[key])
    found = content_hash([(name, _without_docstrings(source)) for name, source in sources])
    with suppress(OSError):
        _KEPT.parent.mkdir(exist_ok=True)
        temporary = _KEPT.with_suffix(f".{os.getpid()}")
        temporary.write_text(json.dumps({key: found}), encoding="utf-8")
        temporary.replace(_KEPT)
    return found


def _without_docstrings(source: bytes) -> str:
    """Return the hash of a syntax tree without docstrings (and comments, which it does not contain)."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list) and body and isinstance(body[0], ast.Expr):
            text = body[0].value
            if isinstance(text, ast.Constant) and isinstance(text.value, str):
                del body[0]
    return hashlib.sha256(ast.dump(tree).encode("utf-8", "surrogatepass")).hexdigest()


def package_versions(names: tuple[str, ...] = NUMERICAL_LIBRARIES + OTHER_LIBRARIES) -> dict[str, str]:
    """Return the versions of installed packages."""
    return {name: _version(name) for name in names}


@cache
def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "missing"


@lru_cache(maxsize=1)
def numeric_platform() -> str:
    """Return the numeric platform of this machine, which determines the last bits of floating-point results."""
    import numpy as np

    # stubs leave the modes of show_config untyped
    simd = np.show_config(mode="dicts")["SIMD Extensions"]  # type: ignore[index,call-overload,unused-ignore]
    features = "+".join([*simd["baseline"], *simd.get("found", [])])
    blas = "/".join(_openblas_kernels()) or "unknown"
    python = f"{sys.version_info.major}.{sys.version_info.minor}"
    kernels = f"blas {blas}; simd {features}; numba {_numba_target()}"
    return f"{sys.platform} {platform.machine()}; python {python}; {kernels}"


def _numba_target() -> str:
    """Return the processor that Numba compiles for, and a hash of its enabled features."""
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


# --- circumstances of a run -----------------------------------------------------------------------------------------


def now() -> str:
    """Return the current time in UTC, for example ``2026-11-21T04:00:00Z``."""
    return as_text(datetime.now(UTC))


def as_text(moment: datetime) -> str:
    """Return a time in UTC in stored form."""
    return moment.strftime("%Y-%m-%dT%H:%M:%SZ")


def session_info(spec_text: str) -> dict[str, Any]:
    """Describe the run that is about to start."""
    return {
        "argv": sys.argv,
        "pid": os.getpid(),
        "host": platform.node(),
        "system": platform.platform(),
        "processors": os.cpu_count(),
        "packages": {"python": platform.python_version(), **package_versions()},
        "git_commit": git_commit(Path(__file__).resolve().parents[2]),
        "spec": spec_text,
    }


def git_commit(root: Path) -> str | None:
    """Return the commit of a checkout; None without a repository or git."""
    # An installed package may lie inside another repository.
    if (root / ".git").exists():
        with suppress(OSError, subprocess.CalledProcessError):
            command = ["git", "-C", str(root), "rev-parse", "HEAD"]
            return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    return None
