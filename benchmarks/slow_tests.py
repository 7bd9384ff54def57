"""Processor time of the tests, and the unmarked ones that take too much of it.

python benchmarks/slow_tests.py                 # the tests of `make test`
python benchmarks/slow_tests.py -m slow         # those of `make test-slow`; other options of pytest likewise

Times are user and system time of the process and of its ended children, also in units of the loop
``[i*i for i in range(5_000_000)]``, since machines differ in speed. A file's first test includes its imports and shared
fixtures. Unmarked tests should take at most 12 loops each.
"""

import collections
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest

#: Loops that an unmarked test may take.
LIMIT = 12.0
LISTED = 30


def used():
    """Return the processor time of this process and of its ended children [s]."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def loop():
    """Return the processor time of the reference loop [s]: the least of three."""
    found = []
    for _ in range(3):
        begun = time.process_time()
        [i * i for i in range(5_000_000)]
        found.append(time.process_time() - begun)
    return min(found)


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_protocol(item, nextitem):
    """Write the time of each test to the folder of the benchmark; one file for each worker."""
    begun = used()
    result = yield
    with Path(os.environ["CTID_TEST_TIMES"], f"{os.getpid()}.txt").open("a") as file:
        file.write(f"{used() - begun:.3f} {item.nodeid}\n")
    return result


def main():
    """Run the tests and print the table."""
    with tempfile.TemporaryDirectory() as folder:
        words = ["-q", "-n", "logical", "--dist", "loadfile", "--no-loadscope-reorder", "-p", "benchmarks.slow_tests"]
        environment = os.environ | {"CTID_TEST_TIMES": folder, "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": "."}
        before, begun, cpu = loop(), time.monotonic(), used()
        done = subprocess.run([sys.executable, "-m", "pytest", *words, *sys.argv[1:]], env=environment)
        wall, cpu, after = time.monotonic() - begun, used() - cpu, loop()
        lines = [line.split(" ", 1) for file in Path(folder).iterdir() for line in file.read_text().splitlines()]
    if keep := os.environ.get("CTID_TEST_TIMES"):
        Path(keep).write_text("".join(f"{seconds} {name}\n" for seconds, name in lines))
    unit = 0.5 * (before + after)
    tests = sorted(((float(seconds), name) for seconds, name in lines), reverse=True)
    files = collections.Counter()
    for seconds, name in tests:
        files[name.partition("::")[0]] += seconds
    print(f"loop {before:.3f} s before, {after:.3f} s after; {len(tests)} tests in {wall:.0f} s")
    print(f"processor time of pytest {cpu:.0f} s = {cpu / unit:.0f} loops\n\nslowest tests:")
    for seconds, name in tests[:LISTED]:
        print(f"{seconds:7.2f} s {seconds / unit:6.1f} loops  {name}")
    print("\nslowest files:")
    for name, seconds in files.most_common(LISTED):
        print(f"{seconds:7.2f} s {seconds / unit:6.1f} loops  {name}")
    above = [name for seconds, name in tests if seconds > LIMIT * unit]
    print(f"\nabove {LIMIT:g} loops: {len(above)}", *above, sep="\n  ")
    sys.exit(done.returncode)


if __name__ == "__main__":
    main()
