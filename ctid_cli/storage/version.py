"""What the bits of a result depend on besides its specification: the code and the machine's arithmetic.

Estimates are only put side by side when both agree. The *code version* covers the floors of the package that compute
(signals to estimators) and the numerical libraries; the *numeric platform* covers what makes the same code give other
last bits: the kernels that OpenBLAS and NumPy choose for the processor, and the Python version.
"""

from __future__ import annotations

import ctypes
import hashlib
import platform
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from importlib import metadata
from pathlib import Path

#: Folders of the package whose sources decide what is computed.
COMPUTING_FLOORS = ("signals", "models", "filtering", "inference", "estimation", "estimators", "frequency")
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


@dataclass(frozen=True)
class Origin:
    """Where estimates come from."""

    code_version: str
    platform: str
    packages: tuple[tuple[str, str], ...]


@lru_cache(maxsize=1)
def current_origin() -> Origin:
    """Where estimates computed by this process and its workers come from."""
    packages = (("python", platform.python_version()), *package_versions(NUMERICAL_LIBRARIES).items())
    return Origin(code_version(), numeric_platform(), packages)


def code_version(package: Path | None = None) -> str:
    """Hash of the sources that compute and of the numerical libraries' versions."""
    root = package if package is not None else Path(__file__).resolve().parents[1]
    digest = hashlib.sha256()
    for floor in COMPUTING_FLOORS:
        for file in sorted((root / floor).rglob("*.py")):
            # Line ends differ between checkouts of the same source.
            source = file.read_bytes().replace(b"\r\n", b"\n")
            name = file.relative_to(root).as_posix().encode()
            digest.update(b"%d %s %d\n" % (len(name), name, len(source)) + source)
    for library, version in package_versions(NUMERICAL_LIBRARIES).items():
        digest.update(f"{library} {version}\n".encode())
    return digest.hexdigest()[:16]


def package_versions(names: tuple[str, ...] = NUMERICAL_LIBRARIES + OTHER_LIBRARIES) -> dict[str, str]:
    """Versions of installed packages."""
    versions = {}
    for name in names:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            versions[name] = "missing"
    return versions


def numeric_platform() -> str:
    """What decides the last bits of floating-point results on this machine."""
    import numpy as np

    # stubs leave the modes of show_config untyped
    simd = np.show_config(mode="dicts")["SIMD Extensions"]  # type: ignore[index,call-overload,unused-ignore]
    features = "+".join([*simd["baseline"], *simd.get("found", [])])
    blas = "/".join(_openblas_kernels()) or "unknown"
    python = f"{sys.version_info.major}.{sys.version_info.minor}"
    return f"{sys.platform} {platform.machine()}; python {python}; blas {blas}; simd {features}"


def _openblas_kernels() -> Iterator[str]:
    import numpy as np
    import scipy

    for package in (np, scipy):
        root = Path(str(package.__file__)).parent
        for folder in (root.parent / f"{package.__name__}.libs", root / ".dylibs"):
            for file in sorted(folder.glob("*openblas*")):
                name = _core_name(file)
                if name:
                    yield name


def _core_name(library: Path) -> str | None:
    try:
        loaded = ctypes.CDLL(str(library))
    except OSError:
        return None
    for name in _CORE_NAME_FUNCTIONS:
        function = getattr(loaded, name, None)
        if function is not None:
            function.argtypes = []
            function.restype = ctypes.c_char_p
            core = function()
            return core.decode("ascii", "replace") if core else None
    return None
