"""Custom code: classes named in a specification by file or module.

Files are read once, and imports use this content in this process and in its workers: changes of the files during a run
have no effect.
"""

import ast
import builtins
import hashlib
import importlib
import importlib.util
import os
import re
import sys
import sysconfig
import traceback
from collections.abc import Iterable, Iterator
from contextlib import redirect_stdout, suppress
from dataclasses import dataclass
from functools import cache
from importlib.abc import MetaPathFinder, SourceLoader
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Any, Self

#: Exceptions that Python's parser may raise.
_UNREADABLE = (SyntaxError, ValueError, RecursionError, MemoryError)
#: Maximum length of the text that names a class.
MAX_LENGTH = 200
_PACKAGE = Path(__file__).resolve().parent
#: Folder of configs, studies and published results: in an installed package, or the checkout.
DATA = _PACKAGE / "_data" if (_PACKAGE / "_data").is_dir() else _PACKAGE.parent
#: The studies that are shipped with the program.
STUDIES = DATA / "experiments"
_STANDARD = tuple(sysconfig.get_path(name) for name in ("stdlib", "platstdlib"))


class CustomCodeError(ValueError):
    """An error of custom code."""


@dataclass(frozen=True)
class Source:
    """Content of a module's file when it was read."""

    path: str
    content: bytes
    #: SHA-256 of each data file listed in FILES, by name.
    data: tuple[tuple[str, str], ...] = ()

    @classmethod
    def read(cls, file: Path) -> Self:
        """Read a module's file and hash the data files that it lists."""
        if file.exists() and not file.is_file():
            raise CustomCodeError(f"{file.name} is no ordinary file")
        content = file.read_bytes()
        data = []
        for name in _data_files(content, file.name):
            try:
                data.append((name, hashlib.sha256((file.parent / name).read_bytes()).hexdigest()))
            except OSError as error:
                text = f"{name}, which FILES in {file.name} names, cannot be read: {error.strerror}"
                raise CustomCodeError(text) from None
        return cls(str(file), content, tuple(data))

    @property
    def is_package(self) -> bool:
        """Whether it contains other modules."""
        return Path(self.path).name == "__init__.py"


def find_class(kind: str, folder: Path) -> type[Any]:
    """Return the class named by ``./file.py:Class``, relative to a folder, or ``package.module:Class``."""
    place, _, name = kind.rpartition(":")
    if not place or not name.isidentifier() or len(kind) > MAX_LENGTH:
        raise CustomCodeError(f"must be './file.py:Class' or 'package.module:Class', not the text {kind[:40]!r}")
    file = _file_of(place, folder)
    module = place if file is None else _serve_file(file, place)
    try:
        # Prints of the module must not appear in the output of a command.
        with redirect_stdout(sys.stderr):
            found = getattr(importlib.import_module(module), name, None)
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        raise CustomCodeError(f"{place} cannot be imported: {reason(error)}") from None
    if not isinstance(found, type):
        raise CustomCodeError(f"{place} has no class {name}" if found is None else f"{kind} is no class")
    return found


def is_shipped(kind: str, folder: Path) -> bool:
    """Return whether a kind names a file of the studies shipped with the program.

    Such code is trusted like the program itself, whatever the specification. A link in another place to such a file is
    not trusted: imports of the file would be resolved next to the link.
    """
    file = _file_of(kind.rpartition(":")[0], folder)
    try:
        return file is not None and not file.is_symlink() and file.parent.resolve().is_relative_to(STUDIES)
    except (OSError, RuntimeError, ValueError):  # circular links, a zero byte
        return False


def _file_of(place: str, folder: Path) -> Path | None:
    """Return the file named by a kind; None if it names a module."""
    return Path(os.path.abspath(folder / place)) if "/" in place or place.endswith(".py") else None


def reason(error: BaseException) -> str:
    """Describe an exception in a clause: its message, and the last line of custom code in its traceback."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if is_custom_file(frame.filename)]
    where = f" ({Path(frames[-1].filename).name}:{frames[-1].lineno})" if frames else ""
    text = " ".join(str(error).split())
    return f"{type(error).__name__}{': ' if text else ''}{text[:200]}{where}"


# --------------------------------------------------------------------------------------------------------------------
# Files used by imports


_SERVED: dict[str, Source] = {}
#: Names of modules loaded from files, made from the file name and a hash of the content of all its modules.
_MADE_NAME = r"custom_\w+_[0-9a-f]{12}(\.\w+)*"


class _Loader(SourceLoader):
    """Loader of a module from stored content; it imports neighbouring modules from their stored content.

    Neighbours have private names in ``sys.modules``, so that several folders may have a ``helpers.py``.
    """

    def __init__(self, source: Source) -> None:
        self.source = source

    def get_filename(self, fullname: str) -> str:
        return self.source.path

    def get_data(self, path: str | bytes) -> bytes:
        return self.source.content

    def exec_module(self, module: ModuleType) -> None:
        main = module.__name__.partition(".")[0]

        def load(name: str, given: Any = None, local: Any = None, names: Any = (), level: int = 0) -> Any:
            top, private = name.partition(".")[0], f"{main}.{name}"
            if level or f"{main}.{top}" not in _SERVED:
                return builtins.__import__(name, given, local, names, level)
            for full in (private, *(f"{private}.{part}" for part in names or ())):
                if full in _SERVED:
                    importlib.import_module(full)
            return sys.modules[private if names else f"{main}.{top}"]

        # Import statements of a module call this function.
        module.__dict__["__builtins__"] = {**vars(builtins), "__import__": load}
        super().exec_module(module)


class _Finder(MetaPathFinder):
    def find_spec(self, fullname: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        source = _SERVED.get(fullname)
        if source is None:
            # The Numba cache imports a module by its earlier name, which changes with any file of the folder.
            return ModuleSpec(fullname, None, is_package=True) if re.fullmatch(_MADE_NAME, fullname) else None
        return importlib.util.spec_from_file_location(
            fullname, source.path, loader=_Loader(source), submodule_search_locations=[]
        )


def served() -> dict[str, Source]:
    """Return all loaded sources, which another process needs before it can read the rest of a job."""
    return dict(_SERVED)


def serve(sources: dict[str, Source]) -> None:
    """Make modules importable from their sources by name."""
    if not any(isinstance(finder, _Finder) for finder in sys.meta_path):
        sys.meta_path.insert(0, _Finder())
    for name, source in sources.items():
        _SERVED.setdefault(name, source)


def _serve_file(path: Path, place: str) -> str:
    """Return the module name under which a file is loaded; imported neighbours are submodules of it."""
    try:
        sources = _with_neighbours(path)
    except FileNotFoundError:
        raise CustomCodeError(f"there is no file {place}; names start at the folder of the specification") from None
    except CustomCodeError:
        raise
    except (OSError, ValueError) as error:
        raise CustomCodeError(f"{place} cannot be read: {getattr(error, 'strerror', None) or error}") from None
    contents = [(name, source.content, source.data) for name, source in sorted(sources.items())]
    digest = hashlib.sha256(repr(contents).encode())
    # Named by content, so that a changed file gives another module.
    main = f"custom_{re.sub(r'[^0-9A-Za-z_]', '_', path.stem)}_{digest.hexdigest()[:12]}"
    serve({f"{main}.{name}" if name else main: source for name, source in sources.items()})
    return main


def _with_neighbours(path: Path) -> dict[str, Source]:
    """Return a file, with an empty name, and the modules in its folder that it imports, directly or not."""
    found, waiting = {"": Source.read(path)}, [""]
    while waiting:
        name = waiting.pop()
        for other in imports_of(found[name], name):
            file = None if other in found or _is_installed(other) else _beside(path.parent, other)
            if file is not None:
                found[other] = Source.read(file)
                waiting.append(other)
    return found


def _beside(folder: Path, name: str) -> Path | None:
    base = folder.joinpath(*name.split("."))
    return next((file for file in (base.with_suffix(".py"), base / "__init__.py") if file.is_file()), None)


# --------------------------------------------------------------------------------------------------------------------
# Content of a module


def is_custom_file(file: str | None) -> bool:
    """Return whether a file belongs neither to Python, nor to an installed package, nor to ctid."""
    if not file or not os.path.isabs(file):
        return False
    parts = Path(file).parts
    installed = "site-packages" in parts or "dist-packages" in parts or file.startswith(_STANDARD)
    return not installed and not Path(file).is_relative_to(_PACKAGE)


def source_of(name: str) -> Source | None:
    """Return the source of a custom module; None for any other name."""
    if name in _SERVED:
        return _SERVED[name]
    # Importing a module may have any side effect.
    with suppress(BaseException):
        spec = importlib.util.find_spec(name)
        if spec is not None and is_custom_file(spec.origin):
            return Source.read(Path(str(spec.origin)))
    return None


def _is_installed(name: str) -> bool:
    top = name.partition(".")[0]
    with suppress(ImportError, ValueError):
        spec = importlib.util.find_spec(top)
        places: Iterable[str | None] = () if spec is None else [spec.origin, *(spec.submodule_search_locations or ())]
        return spec is not None and not any(map(is_custom_file, places))
    return False


def imports_of(source: Source, name: str) -> set[str]:
    """Return the names in all import statements of a module, which may be modules."""
    found = _named(source.content, name if source.is_package else name.rpartition(".")[0])
    neighbours = {other: f"{name.partition('.')[0]}.{other}" for other in found}
    return {private if private in _SERVED else other for other, private in neighbours.items()} - {name}


def _data_files(content: bytes, place: str) -> tuple[str, ...]:
    """Return the value of FILES in a module: names of data files, relative to its folder."""
    try:
        body = ast.parse(content).body
    except _UNREADABLE:
        return ()
    for node in body:
        if isinstance(node, ast.Assign) and any(isinstance(at, ast.Name) and at.id == "FILES" for at in node.targets):
            with suppress(ValueError):
                names = ast.literal_eval(node.value)
                if isinstance(names, (list, tuple)) and all(isinstance(name, str) for name in names):
                    return tuple(names)
            raise CustomCodeError(f'FILES in {place} must be a list of names that stands there: FILES = ["table.csv"]')
    return ()


@cache
def _named(content: bytes, package: str) -> set[str]:
    try:
        nodes = list(ast.walk(ast.parse(content)))
    except _UNREADABLE:
        return set()
    return {parent for node in nodes for full in _imported(node, package) for parent in _parents(full)}


def _imported(node: ast.AST, package: str) -> Iterator[str]:
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
        base = node.module or ""
        if node.level:
            above = package.split(".")[: len(package.split(".")) - node.level + 1]
            base = ".".join(filter(None, [*above, base]))
        yield from (f"{base}.{alias.name}".lstrip(".") for alias in node.names)


def _parents(full: str) -> Iterator[str]:
    parts = full.split(".")
    return (".".join(parts[: k + 1]) for k in range(len(parts)))
