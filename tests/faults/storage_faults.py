"""Faults at storage calls: the process is killed before, inside or after each, or the call fails, once or from then on.

Run as a program of its own, under a library that sees every call: ``run_under`` starts it.
"""

from __future__ import annotations

import ctypes
import hashlib
import json
import os
import random
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from time import monotonic

from ctid_cli.storage.store import load_estimates
from tests.faults.counts import Count
from tests.faults.trials import Found, Place, Reference, apart, errors_of, hasten, plan, run

ROOT = Path(__file__).resolve().parents[2]
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

    def judge(say: Callable[[str], object]) -> None:
        found = reference.judge(folder, said if is_run else (), thoroughly=killed)
        say(json.dumps(found).replace(" ", "\0"))

    judged, also = apart(judge)
    return [*wrong, *also, *(tuple(entry) for entry in json.loads(" ".join(judged).replace("\0", " ") or "[]"))]


def campaign(at_most: int, begin: int, seconds: float) -> list[Count]:
    """Counts of all kinds of faults: trials drawn from all of them, from one on, so many or for so long."""
    until = monotonic() + seconds
    hasten()
    place = Place()
    counts: dict[str, Count] = {}
    try:
        kept = place.top / "kept"
        reference = Reference(kept / "reference")
        cases = []
        for scene in scenes(kept):
            truth = ""
            if scene.name.startswith("reading"):
                said, _ = apart(lambda say, scene=scene: scene.act(scene.set(place), say))  # type: ignore[misc]
                truth = " ".join(said)
            calls = scene.calls(place)
            cases += [(scene, fault, truth) for fault in faults_of(calls)]
        for scene, fault, truth in _drawn(cases)[begin : begin + at_most]:
            count = counts.setdefault(fault.name, Count(fault.name))
            name = f"{scene.name}, call {fault.at}, {os.strerror(fault.error)}"
            count.add(trial(scene, fault, place, reference, truth), name)
            if sum(count.trials for count in counts.values()) % 100 == 99:
                print(f"{sum(count.trials for count in counts.values()) + 1} trials", file=sys.stderr, flush=True)
            if monotonic() > until:
                break
    finally:
        place.close()
    return sorted(counts.values(), key=lambda count: count.kind)


def _drawn(cases: list[tuple[Scene, Fault, str]]) -> list[tuple[Scene, Fault, str]]:
    """Cases in an order of chance in which all kinds of faults take turns, those that kill four times as often."""
    random.Random(7).shuffle(cases)
    seen: dict[str, int] = {}

    def turn(case: tuple[Scene, Fault, str]) -> float:
        fault = case[1]
        seen[fault.name] = number = seen.get(fault.name, 0) + 1
        return number / (4 if fault.how in KILLS else 1)

    return sorted(cases, key=turn)


def run_under(folder: Path, at_most: int, begin: int = 0, seconds: float = 1e9) -> list[Count]:
    """Run the campaign in a process that the library is loaded into."""
    library = folder / "interpose.so"
    source = Path(__file__).with_name("interpose.c")
    subprocess.run(["cc", "-shared", "-fPIC", "-O1", "-o", library, source, "-ldl"], check=True)
    command = [sys.executable, "-m", "tests.faults.storage_faults", str(at_most), str(begin), str(seconds)]
    environment = os.environ | {"LD_PRELOAD": str(library)}
    done = subprocess.run(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    return [Count(**entry) for entry in json.loads(done.stdout.splitlines()[-1])]


if __name__ == "__main__":
    some, first, limit = sys.argv[1:]
    print(json.dumps([asdict(count) for count in campaign(int(some), int(first), float(limit))]))
