"""Faults at storage calls: the process is killed before, inside or after each, or the call fails, once or from then on.

Run as a program of its own, under a library that sees every call: interpose.c.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import random
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from ctid_cli.storage.store import load_estimates
from tests.faults.campaigns import serve
from tests.faults.counts import Trial
from tests.faults.trials import Found, Place, Reference, apart, apart_found, errors_of, hasten, plan, run

#: The kinds of calls and faults of interpose.c, in its order.
CALLS = (
    *("open to read", "open to write", "read", "write", "sync", "rename", "unlink", "truncate", "mkdir", "chmod"),
    *("lock", "lock a part", "close", "map"),
)
NOTHING, KILL_BEFORE, KILL_INSIDE, KILL_AFTER, ONCE, ALWAYS, SHORT, FULL, READ_ONLY = range(9)
KILLS = (KILL_BEFORE, KILL_INSIDE, KILL_AFTER)
_OPENED = ("EACCES", "EPERM", "EMFILE", "ENFILE", "EIO", "ENOMEM", "ESTALE", "ENOENT", "EINTR")
#: What each call may answer, by its manual.
ERRORS = {
    "open to read": _OPENED,
    "open to write": (*_OPENED, "ENOSPC", "EROFS", "EDQUOT"),
    "read": ("EIO", "ESTALE", "EINTR"),
    "write": ("ENOSPC", "EIO", "EDQUOT", "EFBIG", "ESTALE", "EINTR"),
    "sync": ("EIO", "ENOSPC", "EDQUOT", "EROFS", "EINTR"),
    "rename": ("EACCES", "EPERM", "EBUSY", "EDQUOT", "EIO", "ENOSPC", "EROFS", "EXDEV"),
    "unlink": ("EACCES", "EPERM", "EBUSY", "EIO", "EROFS"),
    "truncate": ("EIO", "EPERM", "EFBIG", "EROFS", "EINTR"),
    "mkdir": ("EACCES", "EPERM", "EDQUOT", "ENOSPC", "EROFS", "EIO"),
    "chmod": ("EPERM", "EIO", "EROFS"),
    "lock": ("ENOLCK", "EBADF", "EWOULDBLOCK", "EINTR"),
    "lock a part": ("ENOLCK", "EACCES", "EAGAIN", "EIO", "EINTR"),
    "close": ("EIO", "ENOSPC", "EINTR"),
    "map": ("ENOMEM", "ENFILE"),
}


@dataclass(frozen=True)
class Fault:
    """What happens, at which call, with which error."""

    name: str
    how: int
    at: int
    error: int = 0

    def arm(self, folder: Path) -> None:
        """Have it happen in this process."""
        _library().fault_arm(os.fsencode(folder), self.how, self.at, self.error)


def _library() -> ctypes.CDLL:
    library = ctypes.CDLL(None)
    library.fault_calls.restype = ctypes.c_long
    library.fault_arm.argtypes = [ctypes.c_char_p, ctypes.c_int, ctypes.c_long, ctypes.c_int]
    library.fault_kind.argtypes = [ctypes.c_long]
    return library


class Scene:
    """A folder as it is before the fault, and what is done in it."""

    def __init__(self, name: str, folder: Path | None, act: Callable[[Path, Callable[[str], object]], object]) -> None:
        self.name, self.before, self.act = name, folder, act

    def set(self, place: Place) -> Path:
        """The folder of a trial."""
        folder = place.empty()
        if self.before is not None:
            shutil.copytree(self.before, folder)
        return folder

    def calls(self, place: Place) -> list[str]:
        """The storage calls without a fault."""
        folder = self.set(place)

        def work(say: Callable[[str], object]) -> None:
            Fault("", NOTHING, 0).arm(folder.parent)
            self.act(folder, lambda text: None)
            library = _library()
            number = library.fault_calls()
            library.fault_disarm()
            say(" ".join(str(library.fault_kind(k)) for k in range(1, number + 1)))

        said, wrong = apart(work)
        assert not wrong, wrong
        return [CALLS[int(kind)] for kind in said]


def scenes(folder: Path) -> list[Scene]:
    """A first run, one that goes on after a kill, one that adds to sealed results; reading in two of these states."""
    killed, sealed = folder / "killed", folder / "sealed"

    def to_be_killed(say: Callable[[str], object]) -> None:
        counted: list[str] = []

        def count(text: str) -> None:
            counted.append(text)
            if len(counted) == 2:
                os.kill(os.getpid(), 9)

        run(killed, count)

    apart(to_be_killed)
    run(sealed, toys=plan(1))

    def act(place: Path, say: Callable[[str], object]) -> None:
        run(place, say)

    def read(place: Path, say: Callable[[str], object]) -> None:
        frame = load_estimates(place).map(repr)
        say(hashlib.sha256(frame.to_json().encode()).hexdigest())

    return [
        Scene("first run", None, act),
        Scene("run after a kill", killed, act),
        Scene("run after a run", sealed, act),
        Scene("reading after a kill", killed, read),
        Scene("reading sealed results", sealed, read),
    ]


def faults_of(calls: list[str]) -> Iterator[Fault]:
    """Every fault at every call."""
    size = 0
    for k, kind in enumerate(calls, 1):
        yield Fault("killed before a call", KILL_BEFORE, k)
        yield Fault("killed after a call", KILL_AFTER, k)
        if kind == "write":
            size += 4096
            yield Fault("killed inside a write", KILL_INSIDE, k)
            yield Fault("half of a write", SHORT, k)
        if kind in ("write", "mkdir", "open to write", "rename", "truncate"):
            yield Fault("read-only from a call on", READ_ONLY, k)
        for name, error in errors_of(*ERRORS[kind]).items():
            yield Fault(f"error once ({kind})", ONCE, k, error)
            if name != "EINTR":  # which the system never says for ever
                yield Fault(f"error from then on ({kind})", ALWAYS, k, error)
    for room in range(0, size, 997):
        yield Fault("disk full after some bytes", FULL, room)


def trial(scene: Scene, fault: Fault, place: Place, reference: Reference, truth: str) -> Found:
    """What a fault brings about."""
    folder = scene.set(place)
    is_run = not scene.name.startswith("reading")

    def work(say: Callable[[str], object]) -> None:
        fault.arm(folder.parent)
        scene.act(folder, say)

    said, wrong = apart(work)
    killed = fault.how in KILLS
    # What a killed process has in its temporary folder, nobody can remove.
    wrong += [] if killed else place.left()
    if not is_run and said and " ".join(said) != truth:
        wrong.append(("wrong", "something else was read"))

    judged = apart_found(lambda: reference.judge(folder, said if is_run else (), thoroughly=killed))
    return [*wrong, *judged]


def trials() -> None:
    """Answer numbers with trials, drawn from all faults at all calls of all scenes."""
    hasten()
    place = Place()
    try:
        kept = place.top / "kept"
        reference = Reference(kept / "reference")
        cases = []
        for scene in scenes(kept):
            truth = ""
            if scene.name.startswith("reading"):
                said, _ = apart(lambda say, scene=scene: scene.act(scene.set(place), say))  # type: ignore[misc]
                truth = " ".join(said)
            cases += [(scene, fault, truth) for fault in faults_of(scene.calls(place))]
        cases = _drawn(cases)

        def tried(number: int) -> Trial:
            scene, fault, truth = cases[number]
            error = f", {os.strerror(fault.error)}" if fault.error else ""
            name = f"{scene.name}, call {fault.at}{error}"
            return Trial(fault.name, number, name, trial(scene, fault, place, reference, truth))

        serve(tried)
    finally:
        place.close()


def _drawn(cases: list[tuple[Scene, Fault, str]]) -> list[tuple[Scene, Fault, str]]:
    """Cases in an order of chance in which all kinds of faults take turns, those that kill four times as often."""
    random.Random(7).shuffle(cases)
    seen: dict[str, int] = {}

    def turn(case: tuple[Scene, Fault, str]) -> float:
        fault = case[1]
        seen[fault.name] = number = seen.get(fault.name, 0) + 1
        return number / (4 if fault.how in KILLS else 1)

    return sorted(cases, key=turn)


if __name__ == "__main__":
    trials()
