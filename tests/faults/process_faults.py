"""Faults of processes: signals to workers and to the run itself, limits, two runs at once, folders that go away."""

from __future__ import annotations

import contextlib
import os
import random
import resource
import shutil
import signal
import subprocess
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from time import monotonic
from typing import Any

from ctid_cli.errors import RefusedError
from ctid_cli.running import engine
from ctid_cli.running.pool import end_idle_workers
from ctid_cli.storage.store import load_estimates
from tests.faults.campaigns import serve
from tests.faults.counts import Trial
from tests.faults.trials import PATIENCE, Found, Place, Reference, Started, apart, apart_found, hasten, plan, run
from tests.running.fakes import FakePlan, Toy
from tests.running.hostile import Hostile

Say = Callable[[str], object]
#: Of a trial: what it was, how many faults, what they brought about.
Tried = tuple[str, int, Found]
#: Signals to a worker: those that end it, and those that it must not care about.
TO_WORKERS = ("SIGKILL", "SIGSTOP", "SIGKILL", "SIGTERM", "SIGINT", "SIGHUP", "SIGXCPU", "SIGQUIT")
#: Statuses that an estimator which misbehaves may get; where there is none, its estimate is not stored.
HOSTILE: dict[str, set[str]] = {
    "leave": {"CRASHED"},
    "be killed": set(),
    "speak in halves": {"FAILED"},
    "be speechless": {"FAILED"},
    "loop": {"TIMEOUT"},
    "sleep": {"TIMEOUT"},
    "stop": {"TIMEOUT"},
    "grow": {"MEMORY"},
    "ask for too much": {"MEMORY"},
    "open files": {"TIMEOUT"},
}
RETRIED = ("CRASHED", "FAILED", "TIMEOUT", "MEMORY")
TO_PARENTS = ("SIGKILL", "SIGTERM", "SIGINT", "SIGHUP", "SIGQUIT", "SIGSEGV")


def slow_plan(runs: int = 12) -> Any:
    """Data sets whose estimates take a little while, of two cells."""
    return FakePlan(Toy(seconds=0.02), Toy(order=3, mischief="raise", at=1), runs=runs)


class Trials:
    """Trials in one place."""

    def __init__(self) -> None:
        hasten()
        self.place = Place()
        self.kept = self.place.top / "kept"
        self.quick, self.slow = Reference(self.kept / "quick"), Reference(self.kept / "slow", slow_plan())

    def trial(self, number: int) -> Trial:
        """A trial of the kind whose turn it is."""
        kind, turn = TURNS[number]
        self.rng = random.Random(f"{kind}/{turn}")
        name, faults, found = KINDS[kind][1](self)
        return Trial(kind, number, name, found, faults)

    def judged(self, reference: Reference, said: list[str]) -> Found:
        """What is wrong afterwards."""
        return [*apart_found(lambda: reference.judge(self.place.folder, said)), *self.place.left()]

    def workers_of(self, parent: int) -> list[int]:
        """The worker processes of a run."""
        asked = subprocess.run(["ps", "-o", "pid=,args=", "--ppid", str(parent)], capture_output=True, text=True)
        return [int(line.split()[0]) for line in asked.stdout.splitlines() if "popen_loky" in line]

    def pooled(self, jobs: int, toys: Any = None, first: Callable[[], object] = lambda: None) -> Started:
        """A run with worker processes."""
        folder = self.place.empty()

        def work(say: Say) -> None:
            first()
            try:
                run(folder, say, toys or self.slow.plan, executor=None, jobs=jobs)
            finally:
                end_idle_workers()

        return Started(work)

    def signals_to_workers(self) -> Tried:
        """A run whose workers get one signal after the other."""
        started, sent, most = self.pooled(2), list[str](), self.rng.randrange(1, 15)
        deadline = monotonic() + PATIENCE
        while started.process.is_alive() and len(sent) < most and monotonic() < deadline:
            started.listen(self.rng.uniform(0.0, 0.2))
            found = self.workers_of(int(started.process.pid or 0))
            # In the beginning they only load what they need.
            if not found or (not started.said and self.rng.random() < 0.9):
                continue
            name, worker = self.rng.choice(TO_WORKERS), self.rng.choice(found)
            try:
                os.kill(worker, getattr(signal, name))
                sent.append(name)
                if name == "SIGSTOP":
                    time.sleep(self.rng.uniform(0.0, 0.1))
                    os.kill(worker, signal.SIGCONT)
            except ProcessLookupError:
                continue
        said, wrong = started.end()
        return ", ".join(sent), len(sent), [*wrong, *self.judged(self.slow, said)]

    def signal_to_parent(self) -> Tried:
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
        return f"{name} after {len(said)} estimates", 1, [*wrong, *self.judged(self.slow, said)]

    def hostile(self) -> Tried:
        """Estimators that die, hang, take all memory or are stopped: they are named, all others are stored."""
        marker = self.kept / "they behave"
        mischiefs = self.rng.sample(sorted(HOSTILE), 4)
        culprits = [(name, self.rng.randrange(3)) for name in mischiefs]
        toys = [Hostile(name, at=at, order=5 + k, marker=str(marker)) for k, (name, at) in enumerate(culprits)]
        limits = {"cpu_seconds": 2.0, "wall_seconds": 6.0, "memory_mb": 300}
        some: Any = FakePlan(Toy(), *toys, Toy(order=4), levels=(5,), runs=3, limits=limits)
        marker.touch()
        shutil.rmtree(self.kept / "hostile", ignore_errors=True)
        reference = Reference(self.kept / "hostile", some)
        marker.unlink()
        jobs = self.rng.choice((1, 2))
        # What the limits allow is no hang.
        said, wrong = self.pooled(jobs, some).end(patience=2 * PATIENCE)
        named = {(f"toy{k}", at): HOSTILE[name] for k, (name, at) in enumerate(culprits, 1)}
        wrong += apart_found(lambda: _without(reference, self.place.folder, named))
        marker.touch()
        _, also = apart(lambda say: run(self.place.folder, toys=some, retry=RETRIED) and None)
        return ", ".join(mischiefs), len(mischiefs), [*wrong, *also, *self.judged(reference, said)]

    def limit(self) -> Tried:
        """A run that may open few files, or have little memory."""
        what, room = self.rng.choice(
            [(resource.RLIMIT_NOFILE, self.rng.randrange(8, 40)), (resource.RLIMIT_AS, self.rng.randrange(1, 40) << 26)]
        )

        def be_limited() -> None:
            # What is there counts too.
            before = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
            most = room if what == resource.RLIMIT_NOFILE else before + room
            resource.setrlimit(what, (most, most))

        said, wrong = self.pooled(1, first=be_limited).end()
        name = f"{room} files" if what == resource.RLIMIT_NOFILE else f"{room >> 20} MB"
        return name, 1, [*wrong, *self.judged(self.slow, said)]

    def two_at_once(self) -> Tried:
        """Two runs in one folder, one of which may be killed."""
        folder = self.place.empty()
        both = []
        for _ in range(2):
            both.append(Started(lambda say: run(folder, say) and None))
            time.sleep(self.rng.uniform(0.0, 0.15))
        if killed := self.rng.random() < 0.3:
            both[0].process.kill()
        ended = [started.end() for started in both]
        said = [word for words, _ in ended for word in words]
        found = [*(found for _, wrong in ended for found in wrong), *self.judged(self.quick, said)]
        return "one killed" if killed else "both to the end", 1, found

    def folder_gone(self) -> Tried:
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
        return change, 1, wrong

    def other_origin(self) -> Tried:
        """Results of other code, packages or processor: nothing is added, nothing changed."""
        folder = self.place.empty()
        run(folder, toys=plan(1))
        before = _content(folder)
        known = engine.current_origins
        changed = self.rng.choice(OTHERS)
        other = replace(next(iter(known(plan()).values())), **changed)
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
        return next(iter(changed)), 1, [*wrong, *self.judged(self.quick, [])]

    def small_disk(self) -> Tried:
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
            found = [*wrong, *self.judged(self.quick, said)]
        finally:
            subprocess.run(["umount", disk], check=True)
        return f"{size} kB{', read-only in the end' if turns else ''}", 1, found


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


def _without(reference: Reference, folder: Path, named: dict[tuple[str, int], set[str]]) -> Found:
    """What is wrong with a run of which some estimates went wrong: all others are there and right, these are named."""
    right, frame = reference.frame.reset_index(), load_estimates(folder)
    others = [key not in named for key in zip(right["estimator"], right["replicate"], strict=True)]
    bad = [key in named for key in zip(frame["estimator"], frame["replicate"], strict=True)]
    found = reference.compare(frame[[not one for one in bad]])
    if missing := set(right["id"][others]) - set(frame["id"]):
        found.append(("lost", f"{len(missing)} estimates of others"))
    for name, replicate, status in frame[bad][["estimator", "replicate", "status"]].itertuples(index=False):
        if status not in named[name, replicate]:
            found.append(("wrong", f"{name} on replicate {replicate} is {status}"))
    return found


def may_mount() -> bool:
    """Whether this process may mount a file system."""
    return os.geteuid() == 0 and subprocess.run(["unshare", "-m", "true"], capture_output=True).returncode == 0


#: How many trials there are of each kind in full.
KINDS: dict[str, tuple[int, Callable[[Trials], Tried]]] = {
    "two runs at once": (50, Trials.two_at_once),
    "folder renamed, deleted or replaced": (50, Trials.folder_gone),
    "other code, packages or processor": (20, Trials.other_origin),
    "signal to the run": (50, Trials.signal_to_parent),
    "signal to a worker": (12, Trials.signals_to_workers),
    "poison, hung, greedy or stopped estimator": (16, Trials.hostile),
    "few descriptors, little memory": (20, Trials.limit),
    "disk full, or read-only meanwhile (mounted)": (30, Trials.small_disk),
}
QUICK = tuple(KINDS)[:4]
#: All of them, such that those of every kind come evenly.
TURNS = [
    turn[1:]
    for turn in sorted(((k + 0.5) / count, kind, k) for kind, (count, _) in KINDS.items() for k in range(count))
]


if __name__ == "__main__":
    if not may_mount():
        raise SystemExit("disks of a size of their own need leave to mount: be root, outside of a container")
    trials = Trials()
    try:
        serve(trials.trial)
    finally:
        trials.place.close()
