"""Inputs tried one after the other in a process of their own, which may hang, crash or fill the memory."""

import contextlib
import io
import multiprocessing
import os
import resource
import tempfile
import traceback
import warnings
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Self

import h5py
from typer.testing import CliRunner

from ctid_cli.cli.main import app
from ctid_cli.errors import CtidError
from ctid_cli.signals.measurement import read_measurement
from ctid_cli.signals.sampled_signal import read_sampled_signal
from ctid_cli.storage.store import read_stored
from tests.faults import mutations
from tests.storage.sealed_images import headed

#: Seconds after which an input counts as one that hangs, and memory that a process may have.
PATIENCE, MEMORY = 60.0, 4 << 30
#: Exit codes of the documentation but that of internal errors.
CODES = (0, 2, 3, 4, 5, 6, 7)
#: What the fuzzer asks, with the options of each; nothing that computes for long.
COMMANDS = {
    "check": ["--time", "--input", "--output", "--hold", "--from", "--to", "--json", "zoh"],
    "check filters": ["--bandwidth", "--largest-error", "--filters", "--beta", "--json", "3"],
    "fit": ["--poles", "--zeros", "--delay", "--offset", "--loss", "--hold", "--bootstrap", "--json", "--validate"],
    "track": ["--tones", "--method", "--interval", "--rate", "--every", "--window", "--format", "csv"],
    "status": ["--out", "--json"],
    "table": ["--format", "csv", "--measure", "bias", "--compare", "search,known", "--out"],
    "show": ["--out", "--json", "--history", "0"],
    "export": ["--format", "json", "--file", "--out"],
    "validate": ["--set", "noise.snr_db=3", "--set", "a.b=[", "--allow-code", "--allow-outside"],
    "run --dry-run": ["--set", "--runs", "--jobs", "--out", "--fresh", "monte_carlo.runs=3"],
    "schema": ["--text", "sampling", "td_srivc"],
}


class FaultError(AssertionError):
    """What no input may bring about."""


def asked(*arguments: object) -> int:
    """Exit code of a command, which ends in a documented way."""
    with warnings.catch_warnings(record=True) as noticed:
        warnings.simplefilter("always", RuntimeWarning)
        done = CliRunner().invoke(app, [str(argument) for argument in arguments])
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise FaultError("".join(traceback.format_exception(done.exception))) from done.exception
    if done.exit_code not in CODES:
        raise FaultError(f"exit code {done.exit_code}: {done.stderr[-600:]}")
    if "Traceback" in done.output or len(done.stderr) > 100_000:
        raise FaultError(f"message: {done.stderr[-600:]}")
    if seen := [warning for warning in noticed if issubclass(warning.category, RuntimeWarning)]:
        raise FaultError(f"warning: {seen[0].message} ({Path(seen[0].filename).name}:{seen[0].lineno})")
    return done.exit_code


def read(reader: Callable[[Path], object], path: Path) -> bool:
    """Whether a file can be read; if it cannot, the reader says why."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        try:
            reader(path)
        except CtidError as error:
            if len(str(error)) > 20_000:
                raise FaultError("a message of more than 20000 letters") from error
            return False
    return True


class Fuzzer:
    """Makes inputs and tries them."""

    def __init__(self, folder: Path, good: list[bytes], tiny: str, *, commands_every: int) -> None:
        self.folder, self.good, self.every = folder, good, commands_every
        self.bases = mutations.specifications()
        self.files = {}
        for name, content in {"tiny.yaml": tiny.encode(), "short.csv": b"t,u,y\n0,1,2\n1,-1,3\n2,1,1\n"}.items():
            (folder / name).write_bytes(content)
            self.files[name] = str(folder / name)
        self.out = folder / "results"
        (self.out / "tiny").mkdir(parents=True, exist_ok=True)
        self.files["out"] = str(self.out)

    def made(self, kind: str, number: int) -> bytes:
        """One input."""
        rng = mutations.rng_of(kind, number)
        match kind:
            case "yaml":
                return mutations.mutated_yaml(rng, rng.choice(self.bases))
            case "csv":
                return mutations.csv_file(rng)
            case "mat":
                return mutations.mat_file(rng)
            case "results":
                return mutations.results_file(rng, rng.choice(self.good)[512:], resealed)
            case _:
                line = mutations.arguments(rng, COMMANDS, self.files)
                return "\0".join(word.replace("\0", "") for word in line).encode("utf-8", "surrogateescape")

    def tried(self, kind: str, data: bytes, number: int) -> None:
        """Try one input; a FaultError, or any other exception, says what it brought about."""
        often = number % self.every == 0
        match kind:
            case "yaml":
                asked("validate", self._written("spec.yaml", data))
            case "csv" | "mat":
                path = self._written(f"data.{kind}", data)
                both = [read(read_measurement, path), read(read_sampled_signal, path)]
                if often:
                    asked("check", path)
                    asked("track", path, "--tones", "1", "--out", self.folder / "track")
                del both
            case "results":
                self._results(data, number, often=often)
            case _:
                words = data.decode("utf-8", "surrogateescape").split("\0")
                asked(*words)

    def _results(self, data: bytes, number: int, *, often: bool) -> None:
        self._written("results/tiny/runs.h5", data)
        readable = read(read_stored, self.out / "tiny")
        if not (readable or often):
            return
        commands = (["export", "tiny"], ["export", "tiny", "--format", "json"], ["table", "tiny"], ["status", "tiny"])
        command = commands[number % 4] if not often else commands[number // self.every % 4]
        code = asked(*command, "--out", self.out)
        if code == 0 and not readable:
            raise FaultError(f"{command} printed what cannot be read")

    def _written(self, name: str, data: bytes) -> Path:
        path = self.folder / name
        path.write_bytes(data)
        return path


def resealed(image: bytes) -> bytes:
    """A file whose checksums agree with whatever it holds now."""
    from ctid_cli.storage import sealed

    stream = io.BytesIO(image)
    with contextlib.suppress(Exception), h5py.File(stream, "r+") as file:
        file.attrs["checksum"] = "0" * 64
        if not any(item.size and item.size > 10**7 for item in file["estimates"].values() if hasattr(item, "size")):
            file.attrs["checksum"] = sealed._content_checksum(file)
    return headed(stream.getvalue())


class Watched:
    """Inputs tried one after the other in a process that is replaced when it hangs or dies."""

    def __init__(self, fuzzer: Fuzzer, kind: str) -> None:
        self._fuzzer, self._kind = fuzzer, kind
        self._worker: multiprocessing.process.BaseProcess | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *details: object) -> None:
        if self._worker is not None:
            self._worker.kill()
            self._worker.join()

    def tried(self, number: int) -> str:
        """What an input brings about that none may; empty if nothing."""
        if self._worker is None:
            context = multiprocessing.get_context("fork")
            self._pipe, theirs = context.Pipe()
            self._worker = context.Process(target=_work, args=(self._fuzzer, self._kind, theirs))
            self._worker.start()
            theirs.close()
        self._pipe.send(number)
        try:
            if self._pipe.poll(PATIENCE):
                return self._pipe.recv()
            text = f"hangs for {PATIENCE:g} s"
        except (EOFError, ConnectionError):
            self._worker.join()
            text = f"the process died ({self._worker.exitcode})"
        self._worker.kill()
        self._worker.join()
        self._worker = None
        return text


def faults(fuzzer: Fuzzer, kind: str, numbers: Iterable[int]) -> dict[int, str]:
    """What inputs bring about that none may."""
    with Watched(fuzzer, kind) as watched:
        found = {number: watched.tried(number) for number in numbers}
    return {number: text for number, text in found.items() if text}


def _work(fuzzer: Fuzzer, kind: str, connection) -> None:
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, resource.getrlimit(resource.RLIMIT_AS)[1]))
    os.chdir(fuzzer.folder)
    tempfile.tempdir = str(fuzzer.folder)
    with contextlib.suppress(EOFError):
        while True:
            number = connection.recv()
            try:
                data = fuzzer.made(kind, number)
            except Exception:
                connection.send(f"the input cannot be made: {traceback.format_exc()}")
            else:
                connection.send(fault_of(fuzzer, kind, data, number))


def fault_of(fuzzer: Fuzzer, kind: str, data: bytes, number: int = 0) -> str:
    """What an input brings about that none may; empty if nothing."""
    try:
        fuzzer.tried(kind, data, number)
    except Exception as error:
        return (
            f"{type(error).__name__}: {str(error)[-3000:]}" if isinstance(error, FaultError) else traceback.format_exc()
        )
    return ""


def shrunk(data: bytes, fails: Callable[[bytes], bool], patience: int = 400) -> bytes:
    """A smaller input that fails too: pieces are left out as long as it does."""
    size = max(len(data) // 2, 1)
    while size and patience:
        for start in range(0, len(data), size):
            patience -= 1
            smaller = data[:start] + data[start + size :]
            if patience <= 0:
                return data
            if smaller and fails(smaller):
                data = smaller
                break
        else:
            size //= 2
    return data
