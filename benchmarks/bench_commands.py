"""Processor time of commands on small data, in loops: one loop is `[i * i for i in range(5_000_000)]`, .18 s when idle.

Each command runs in a fresh interpreter, in turn with the loop, so that the speed of the machine cancels. `printed` is
the time until the table is on stdout, known on Linux only. Exit code 1 if the least time of a command exceeds a limit.

    python benchmarks/bench_commands.py [REPETITIONS]
"""

import contextlib
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from _timing import cpu_of_children

import numpy as np

import ctid_cli

RECORD = Path(ctid_cli.__file__).parent / "templates" / "measured-example.csv"
EXPERIMENT = Path(__file__).resolve().parents[1] / "configs" / "quickstart.yaml"
#: Words of each command, and its limits in loops: until the table is printed, and in all.
COMMANDS = {
    "fit": (["fit", str(RECORD), "--poles", "1", "--zeros", "0", "--delay", "0:20"], 7.2, 10.0),
    "check": (["check", str(RECORD)], None, None),
    "frf": (["frf", str(RECORD)], None, None),
    "status": (["status", "quickstart"], 5.5, 5.5),
    "table": (["table", "quickstart"], 8.3, 8.3),
}


#: One loop, in a fresh interpreter too.
LOOP = "import time; begun = time.process_time(); [i * i for i in range(5_000_000)]; print(time.process_time() - begun)"


def loop():
    """Return the processor time of one loop [s]."""
    return float(subprocess.run([sys.executable, "-c", LOOP], check=True, capture_output=True).stdout)


def run(words, folder):
    """Return the processor times of a command until its table is printed, and in all [s]."""
    begun, printed = cpu_of_children(), float("nan")
    command = [sys.executable, "-m", "ctid_cli.cli.main", *words]
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE) as process:
        text = os.read(process.stdout.fileno(), 1 << 16)
        with contextlib.suppress(OSError):
            used = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
            printed = (int(used[11]) + int(used[12])) / os.sysconf("SC_CLK_TCK")
        process.stdout.read()
    if process.returncode or not text:
        sys.exit(f"ctid {' '.join(words)} failed")
    return printed, cpu_of_children() - begun


def main():
    """Measure the commands, print their times, and compare them with the limits."""
    repetitions = int(sys.argv[1]) if len(sys.argv) > 1 else 7
    slow = []
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "ctid_cli.cli.main", "run", EXPERIMENT, "--jobs", "1"]
        subprocess.run(command, cwd=folder, check=True, capture_output=True)
        print("command  printed [loops]  in all [loops]  in all [s]")
        for name, (words, *limits) in COMMANDS.items():
            run(words, folder)  # compiles kernels
            found = []
            for _ in range(repetitions):
                before, times, after = loop(), run(words, folder), loop()
                found.append([2.0 * time / (before + after) for time in times] + [times[1]])
            printed, ended, seconds = np.min(found, axis=0)
            print(f"{name:7s}  {printed:15.1f}  {ended:14.1f}  {seconds:10.2f}")
            slow += [name] * any(limit and used > limit for used, limit in zip((printed, ended), limits, strict=True))
    if slow:
        sys.exit(f"above the limit: {', '.join(slow)}")


if __name__ == "__main__":
    main()
