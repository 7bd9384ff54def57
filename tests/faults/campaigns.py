"""The campaigns, each tried in a process of its own: it is told one number after the other, and says what came of it.

A process that dies of a trial is replaced, and what it died of counts.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

from tests.faults.counts import Trial

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Campaign:
    """Trials of one module, by number."""

    name: str
    module: str
    #: How many the full form has.
    trials: int
    arguments: tuple[str, ...] = ()
    #: A library that its processes are run under, from a source beside this file.
    under: str | None = None

    def tried(self, numbers: Iterator[int]) -> Iterator[Trial]:
        """Try the numbers in turn; one that ends the process is a traceback."""
        following = next(numbers, None)
        while following is not None:
            with self._process() as process:
                while following is not None:
                    answer = _asked(process, str(following))
                    if answer:
                        yield Trial(**json.loads(answer))
                    else:
                        text = f"the process of the campaign ended with {process.wait()}"
                        yield Trial(self.name, following, "whatever it was", [("traceback", text)])
                    following = next(numbers, None)
                    if not answer:
                        break

    @contextmanager
    def _process(self) -> Iterator[subprocess.Popen[str]]:
        with tempfile.TemporaryDirectory(prefix="faults-") as folder:
            environment = os.environ | ({"LD_PRELOAD": _compiled(self.under, Path(folder))} if self.under else {})
            command = [sys.executable, "-m", self.module, *self.arguments]
            pipe = subprocess.PIPE
            process = subprocess.Popen(command, cwd=ROOT, env=environment, stdin=pipe, stdout=pipe, text=True)
            try:
                if process.stdout is None or process.stdout.readline() != "ready\n":
                    raise RuntimeError(f"{' '.join(command)} does not begin")
                yield process
            finally:
                # It ends when there is nothing left to try, and removes what it made.
                process.communicate()


def _asked(process: subprocess.Popen[str], number: str) -> str:
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        process.stdin.write(number + "\n")
        process.stdin.flush()
    except BrokenPipeError:
        return ""
    return process.stdout.readline()


def _compiled(source: str, folder: Path) -> str:
    library = folder / Path(source).with_suffix(".so").name
    subprocess.run(
        ["cc", "-shared", "-fPIC", "-O1", "-o", library, Path(__file__).with_name(source), "-ldl"], check=True
    )
    return str(library)


def serve(trial: Callable[[int], Trial]) -> None:
    """Answer numbers with trials until there are no more; what else is printed goes to the standard error."""
    numbers, answers = os.fdopen(os.dup(0)), os.fdopen(os.dup(1), "w")
    with open(os.devnull) as nothing:
        os.dup2(nothing.fileno(), 0)
    os.dup2(2, 1)
    print("ready", file=answers, flush=True)
    for line in numbers:
        print(json.dumps(asdict(trial(int(line)))), file=answers, flush=True)


_KINDS = {"yaml": 0.25, "csv": 0.25, "mat": 0.15, "results": 0.15, "arguments": 0.2}
#: All campaigns in full.
CAMPAIGNS = (
    Campaign("processes", "tests.faults.process_faults", 248),
    Campaign("damage", "tests.faults.damage", 360),
    Campaign("storage", "tests.faults.storage_faults", 2600, under="interpose.c"),
    *(Campaign(kind, "tests.faults.fuzz", round(20_000 * share), (kind,)) for kind, share in _KINDS.items()),
)


def named(name: str) -> Campaign:
    """A campaign by its name."""
    return next(one for one in CAMPAIGNS if one.name == name)
