"""`ctid track` of a minute of sound at 48 kHz: seconds of the whole command, start, figure and files included.

    python benchmarks/bench_track.py [--runs 3]

The shortest of some runs, after one that compiles. The target is 20 times real time.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from _timing import cpu_of_children

import numpy as np
from scipy.io import wavfile

RATE, SECONDS, TARGET = 48_000, 60, 20.0
#: Frequencies [Hz]: low ones let a record be thinned, high ones do not.
KINDS = {"one tone": (440.0,), "mains": (50.0, 100.0, 150.0), "up to 3 kHz": (440.0, 1000.0, 3000.0)}


def sound(frequencies):
    t = np.arange(RATE * SECONDS) / RATE
    y = 0.003 * np.random.default_rng(1).standard_normal(t.size)
    for k, frequency in enumerate(frequencies):
        y += 0.3 / (k + 1) * np.sin(2.0 * np.pi * frequency * t + k)
    return np.round(20_000 * y).astype(np.int16)


def tracked(file, tones):
    """Seconds and processor seconds of the command."""
    begun, used = time.perf_counter(), cpu_of_children()
    command = [sys.executable, "-c", "from ctid_cli.cli.main import app; app()", "track", str(file)]
    subprocess.run([*command, "--tones", str(tones), "--out", str(file.parent)], check=True, capture_output=True)
    return time.perf_counter() - begun, cpu_of_children() - used


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=3)
    runs = parser.parse_args().runs
    print(f"{'a minute of':14}{'seconds':>9}{'CPU s':>8}{'times real time':>17}{'target':>8}")
    with tempfile.TemporaryDirectory() as folder:
        for name, frequencies in KINDS.items():
            file = Path(folder, "sound.wav")
            wavfile.write(file, RATE, sound(frequencies))
            tracked(file, len(frequencies))
            seconds, used = np.min([tracked(file, len(frequencies)) for _ in range(runs)], axis=0)
            print(f"{name:14}{seconds:9.2f}{used:8.2f}{SECONDS / seconds:17.1f}{TARGET:8.0f}", flush=True)


if __name__ == "__main__":
    main()
