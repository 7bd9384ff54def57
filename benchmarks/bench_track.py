"""Speed of tracking a minute of sound, relative to real time, by one thread in process and by the command.

    python benchmarks/bench_track.py [--runs 3]

The shortest of some runs, after one that compiles; in process, processor time with the number of tones given and by
default, at 1, 8 and 48 kHz; for the whole command, including start, figure and files, at 48 kHz. The targets at 48 kHz
are 20 times in process, 12 times for the command, and 600 MB.
"""

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.io import wavfile

from ctid_cli.tones.track import track

SECONDS = 60
RATES = (1_000, 8_000, 48_000)
#: Frequencies [Hz]: low ones, for which records can be thinned, and high ones, for which they cannot.
KINDS = {"one tone": (440.0,), "mains": (50.0, 100.0, 150.0), "up to 3 kHz": (440.0, 1000.0, 3000.0)}


class Recorded(NamedTuple):
    """A signal on a regular clock."""

    samples: np.ndarray
    interval: float


def sound(frequencies, rate):
    t = np.arange(rate * SECONDS) / rate
    y = 0.003 * np.random.default_rng(1).standard_normal(t.size)
    for k, frequency in enumerate(frequencies):
        y += 0.3 / (k + 1) * np.sin(2.0 * np.pi * frequency * t + k)
    return np.round(20_000 * y).astype(np.int16)


def in_process(samples, rate, tones, runs):
    """Return the speed relative to real time by processor time."""
    record, used = Recorded(samples / 32768.0, 1.0 / rate), []
    for _ in range(runs):
        begun = time.process_time()
        track(record, tones)
        used.append(time.process_time() - begun)
    return SECONDS / min(used)


def of_command(samples, rate, tones, runs):
    """Return the speed relative to real time by wall time."""
    used = []
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "sound.wav")
        wavfile.write(file, rate, samples)
        command = [sys.executable, "-c", "from ctid_cli.cli.main import app; app()", "track", str(file)]
        for _ in range(runs + 1):
            begun = time.perf_counter()
            subprocess.run([*command, "--tones", str(tones), "--out", folder], check=True, capture_output=True)
            used.append(time.perf_counter() - begun)
    return SECONDS / min(used[1:])


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=3)
    runs = parser.parse_args().runs
    track(Recorded(np.cos(0.3 * np.arange(2000.0)), 1.0), 1)
    print(f"{'a minute of':14}{'rate [Hz]':>10}{'tones given':>13}{'default':>9}{'command':>9}")
    for rate in RATES:
        for name, frequencies in KINDS.items():
            if max(frequencies) > 0.45 * rate:
                continue
            samples = sound(frequencies, rate)
            count = len(frequencies)
            times = [in_process(samples, rate, tones, runs) for tones in (count, None)]
            command = f"{of_command(samples, rate, count, runs):9.1f}" if rate == RATES[-1] else f"{'-':>9}"
            print(f"{name:14}{rate:10}{times[0]:13.1f}{times[1]:9.1f}{command}", flush=True)
    print(f"largest memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB")


if __name__ == "__main__":
    main()
