"""Faults of processes: signals to workers and to the run itself, limits, two runs at once, folders that go away."""

from __future__ import annotations

import contextlib
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from pathlib import Path
from time import monotonic
from typing import Any

from ctid_cli.errors import RefusedError
from ctid_cli.running import engine
from ctid_cli.running.pool import end_idle_workers
from tests.faults.counts import Count
from tests.faults.trials import PATIENCE, Found, Place, Reference, Started, apart, hasten, plan, run
from tests.running.fakes import FakePlan, Toy

Say = Callable[[str], object]
#: Signals to a worker: those that end it, and those that it must not care about.
TO_WORKERS = ("SIGKILL", "SIGSTOP", "SIGKILL", "SIGTERM", "SIGINT", "SIGHUP", "SIGXCPU", "SIGQUIT")
TO_PARENTS = ("SIGKILL", "SIGTERM", "SIGINT", "SIGHUP", "SIGQUIT", "SIGSEGV")


def slow_plan(runs: int = 12) -> Any:
    """Data sets whose estimates take a little while, of two cells."""
    return FakePlan(Toy(seconds=0.02), Toy(order=3, mischief="raise", at=1), runs=runs)


class Trials:
    """Trials in one place, counted by kind of fault."""

    def __init__(self, seed: int, seconds: float) -> None:
        hasten()
        self.rng, self.until = random.Random(seed), monotonic() + seconds
        self.place = Place()
        kept = self.place.top / "kept"
        self.quick, self.slow = Reference(kept / "quick"), Reference(kept / "slow", slow_plan())
        self.counts: dict[str, Count] = {}

    def several(self, number: int, kind: str, trial: Callable[[], Iterator[Found]]) -> None:
        """Count trials of a kind, as many as each call of the function makes, until there are so many."""
        count = self.counts[kind] = Count(kind)
        while count.trials < number and monotonic() < self.until:
            for found in trial():
                count.add(found, f"{kind} {count.trials}")
        print(f"{kind}: {count.trials}", file=sys.stderr, flush=True)

    def judged(self, reference: Reference, said: list[str]) -> Found:
        """What is wrong afterwards."""
        folder = self.place.folder
        judged, wrong = apart(lambda say: say(json.dumps(reference.judge(folder, said)).replace(" ", "\0")))
        text = " ".join(judged).replace("\0", " ")
        return [*wrong, *(tuple(entry) for entry in json.loads(text or "[]")), *self.place.left()]

    def workers_of(self, parent: int) -> list[int]:
        """The worker processes of a run."""
        asked = subprocess.run(["ps", "-o", "pid=,args=", "--ppid", str(parent)], capture_output=True, text=True)
        return [int(line.split()[0]) for line in asked.stdout.splitlines() if "popen_loky" in line]

    def pooled(self, jobs: int) -> Started:
        """A run with worker processes."""
        folder = self.place.empty()

        def work(say: Say) -> None:
            try:
                run(folder, say, self.slow.plan, executor=None, jobs=jobs)
            finally:
                end_idle_workers()

        return Started(work)

    def signals_to_workers(self) -> Iterator[Found]:
        """A run whose workers get one signal after the other."""
        started, sent = self.pooled(2), 0
        while started.process.is_alive():
            started.listen(self.rng.uniform(0.0, 0.2))
            found = self.workers_of(int(started.process.pid or 0))
            # In the beginning they only load what they need.
            if not found or (not started.said and self.rng.random() < 0.9):
                continue
            name, worker = self.rng.choice(TO_WORKERS), self.rng.choice(found)
            try:
                os.kill(worker, getattr(signal, name))
                sent += 1
                if name == "SIGSTOP":
                    time.sleep(self.rng.uniform(0.0, 0.1))
                    os.kill(worker, signal.SIGCONT)
            except ProcessLookupError:
                continue
        said, wrong = started.end()
        yield [*wrong, *self.judged(self.slow, said)]
        yield from [[]] * (sent - 1)

    def signal_to_parent(self) -> Iterator[Found]:
        """A run that gets a signal, alone or with its workers, as from a terminal."""
        started, name = self.pooled(1), self.rng.choice(TO_PARENTS)
        lines, wait = self.rng.randrange(6), self.rng.uniform(0.0, 0.1)
        parent = int(started.process.pid or 0)
        while lines and started.listen(60.0):
            lines -= 1
        time.sleep(wait)
        workers = self.workers_of(parent)
        number = getattr(signal, name)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(parent, number) if self.rng.random() < 0.5 else os.kill(parent, number)
        said, wrong = started.end(killed=(number, signal.SIGKILL))
        deadline = monotonic() + 20.0
        while (alive := [worker for worker in workers if _is_alive(worker)]) and monotonic() < deadline:
            time.sleep(0.05)
        wrong += [("left", f"workers of a run that got {name}: {alive}")] if alive else []
        yield [*wrong, *self.judged(self.slow, said)]

    def limit(self) -> Iterator[Found]:
        """A run that may open few files, or have little memory."""
        what, room = self.rng.choice(
            [(resource.RLIMIT_NOFILE, self.rng.randrange(8, 40)), (resource.RLIMIT_AS, self.rng.randrange(1, 40) << 26)]
        )
        folder = self.place.empty()

        def work(say: Say) -> None:
            # What is there counts too.
            before = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
            most = room if what == resource.RLIMIT_NOFILE else before + room
            resource.setrlimit(what, (most, most))
            run(folder, say, self.slow.plan, executor=None, jobs=1)

        # Each of a dozen attempts starts a process.
        said, wrong = Started(work).end(patience=4 * PATIENCE)
        yield [*wrong, *self.judged(self.slow, said)]

    def two_at_once(self) -> Iterator[Found]:
        """Two runs in one folder, one of which may be killed."""
        folder = self.place.empty()
        both = []
        for _ in range(2):
            both.append(Started(lambda say: run(folder, say) and None))
            time.sleep(self.rng.uniform(0.0, 0.15))
        if self.rng.random() < 0.3:
            both[0].process.kill()
        ended = [started.end() for started in both]
        said = [word for words, _ in ended for word in words]
        yield [*(found for _, wrong in ended for found in wrong), *self.judged(self.quick, said)]

    def folder_gone(self) -> Iterator[Found]:
        """A run whose folder is renamed, deleted or replaced."""
        folder, change = self.place.empty(), self.rng.choice(["rename", "delete", "replace"])
        after, elsewhere = self.rng.randrange(1, 4), self.place.temporary / "elsewhere"
        started = Started(lambda say: run(folder, say) and None)
        while after and started.listen(60.0):
            after -= 1
        before = list(started.said)
        try:
            shutil.rmtree(folder) if change == "delete" else folder.rename(elsewhere)
            if change == "replace":
                shutil.copytree(elsewhere, folder)
        except OSError:
            pass  # it wrote at that moment
        said, wrong = started.end()
        place = elsewhere if elsewhere.exists() else folder
        if change == "delete":
            # What was in the pipe by then, or the run was over.
            wrong += [("lost", "acknowledged later")] if len(said) > len(before) + 12 else []
        else:
            wrong += self.quick.read(place, said)
        yield wrong

    def other_origin(self) -> Iterator[Found]:
        """Results of other code, packages or processor: nothing is added, nothing changed."""
        folder = self.place.empty()
        run(folder, toys=plan(1))
        before = _content(folder)
        known = engine.current_origins
        other = replace(next(iter(known(plan()).values())), **self.rng.choice(OTHERS))
        engine.current_origins = lambda plan: {cell.hash: other for cell in plan.estimators}  # type: ignore[assignment]
        try:
            run(folder)
            wrong = [("wrong", "mixed with results of another origin")]
        except RefusedError:
            wrong = []
        finally:
            engine.current_origins = known
        if _content(folder) != before:
            wrong.append(("wrong", "the folder has changed"))
        yield [*wrong, *self.judged(self.quick, [])]

    def small_disk(self) -> Iterator[Found]:
        """A run on a file system that is full, or is made read-only meanwhile; needs leave to mount."""
        folder = self.place.empty()
        disk = folder.parent
        size, turns = self.rng.randrange(16, 600), self.rng.random() < 0.5
        subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}k", "none", disk], check=True)
        try:
            started = Started(lambda say: run(folder, say) and None)
            if turns and started.listen(10.0):
                time.sleep(self.rng.uniform(0.0, 0.05))
                subprocess.run(["mount", "-o", "remount,ro", disk], capture_output=True)
            said, wrong = started.end()
            subprocess.run(["mount", "-o", "remount,rw,size=50m", disk], check=True)
            yield [*wrong, *self.judged(self.quick, said)]
        finally:
            subprocess.run(["umount", disk], check=True)


OTHERS: list[dict[str, Any]] = [
    {"code_version": "feedfacefeedface"},
    {"platform": "abacus"},
    {"packages": (("python", "2.7"), ("numpy", "1.0"))},
]


def _is_alive(process: int) -> bool:
    try:
        state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"


def _content(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def may_mount() -> bool:
    """Whether this process may mount a file system."""
    return os.geteuid() == 0 and subprocess.run(["unshare", "-m", "true"], capture_output=True).returncode == 0


def campaign(share: float, seed: int = 0, seconds: float = 1e9, *, quick: bool = False) -> list[Count]:
    """Counts of all kinds, or of the quick ones; the share of the full number of trials of each."""
    trials = Trials(seed, seconds)
    kinds: list[tuple[int, str, Callable[[], Iterator[Found]]]] = [
        (60, "two runs at once", trials.two_at_once),
        (60, "folder renamed, deleted or replaced", trials.folder_gone),
        (20, "other code, packages or processor", trials.other_origin),
        (50, "signal to the run", trials.signal_to_parent),
    ]
    if not quick:
        kinds.append((200, "signal to a worker", trials.signals_to_workers))
        kinds.append((30, "few descriptors, little memory", trials.limit))
    if not quick and may_mount():
        kinds.append((40, "disk full, or read-only meanwhile (mounted)", trials.small_disk))
    try:
        for number, kind, trial in kinds:
            trials.several(max(round(number * share), 1), kind, trial)
    finally:
        trials.place.close()
    return list(trials.counts.values())


if __name__ == "__main__":
    some, first, limit = sys.argv[1:]
    print(json.dumps([asdict(count) for count in campaign(float(some), int(first), float(limit))]))
