"""Correctness of valid rows of tracks. Random signals, with too small, correct and too large numbers of tones.

    python benchmarks/track_honesty.py [--signals 1000] [--seed 1] [--show]

Signals of 1000 to 8000 samples: none to five tones over 60 dB, a quarter of them 3 to 12 bins from another, steady,
drifting, decaying or with a step of phase, frequency or amplitude, some with harmonics; white or coloured noise 10 to
60 dB below the strongest, some with spikes or a gap. A valid row is wrong if its frequency differs from the nearest
true one by more than 3.3 of its standard errors and more than .001 of the frequency. A row could be right if the
Cramer-Rao bound for the stretch between two events of the signal (rate of change unknown) is below the accuracy, its
amplitude is at least six of its standard errors, and any other tone at least three bins of the stretch away. All rows
that could be right count, found or not; with one tone too few, only wrong rows count.

Then: named cases, in which no valid row may be off by more than .02 Hz or 3.3 of its standard errors, whichever is
larger; and one to three clean tones in white and coloured noise: coverage of the rows in the middle and their errors
relative to the bound, and for frequencies and amplitudes of the printed table the median standard error relative to the
scatter (target 1/1.2 to 1.2), and coverage.
"""

import argparse
import time
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from ctid_cli.errors import DataError
from ctid_cli.tones.constants import USUAL_ACCURACY
from ctid_cli.tones.summary import summarise
from ctid_cli.tones.track import Track, track

ROWS = 60
KINDS = ("steady", "steady", "steady", "drift", "decay", "phase step", "frequency step", "amplitude step")
FAR, ERRORS, AMPLITUDES, BINS = 64, 3.3, 6.0, 3.0


class Recorded(NamedTuple):
    """A signal on a regular clock."""

    samples: np.ndarray
    interval: float


class Tone(NamedTuple):
    """A tone of a signal."""

    #: Frequency at each sample [1/sample].
    frequency: np.ndarray
    amplitude: np.ndarray
    #: Sample at which it steps; -1 if it does not.
    event: int


class Signal(NamedTuple):
    """A random signal and its components."""

    samples: np.ndarray
    tones: list[Tone]
    #: Standard deviation of the noise, and its autoregressive coefficient.
    noise: float
    pole: float
    events: list[int]


def random_signal(rng: np.random.Generator) -> Signal:
    """Return a random signal."""
    size = int(rng.choice([1000, 2000, 4000, 8000]))
    low, high = max(12.0 / size, 0.01), 0.45
    tones: list[Tone] = []
    samples = np.zeros(size)
    for k in range(int(rng.integers(0, 6))):
        centre = np.exp(rng.uniform(np.log(low), np.log(high)))
        if k and rng.random() < 0.25:
            centre = tones[-1].frequency[0] + rng.uniform(3.0, 12.0) / size * rng.choice([-1, 1])
        centre, amplitude = float(np.clip(centre, low, high)), 10 ** (-rng.uniform(0.0, 3.0))
        tone, phase = _moving(rng, str(rng.choice(KINDS)), size, centre, amplitude)
        orders = (1, 2, 3) if rng.random() < 0.15 else (1,)
        for order in orders:
            if order * tone.frequency.max() < 0.5:
                weight = tone.amplitude / order**2
                samples += weight * np.cos(order * phase + (order > 1))
                tones.append(Tone(order * tone.frequency, weight, tone.event))
    noise, pole = 10 ** (-rng.uniform(0.5, 3.0)), 0.0
    raw = rng.standard_normal(size + 200)
    if rng.random() < 0.5:
        pole = float(rng.uniform(0.3, 0.95) * rng.choice([-1, 1, 1]))
        raw = lfilter([np.sqrt(1.0 - pole**2)], [1.0, -pole], raw)
    samples += noise * raw[200:]
    events = [tone.event for tone in tones if tone.event >= 0]
    if rng.random() < 0.15:
        spikes = rng.integers(0, size, rng.integers(1, 4))
        samples[spikes] += 10 ** rng.uniform(0.0, 6.0)
        events += [int(spike) for spike in spikes]
    if rng.random() < 0.15:
        first = int(rng.integers(0, size - 50))
        samples[first : first + int(rng.integers(1, size // 10))] = np.nan
    return Signal(samples, tones, noise, pole, events)


def _moving(rng: np.random.Generator, kind: str, size: int, centre: float, amplitude: float) -> tuple[Tone, np.ndarray]:
    """Return a tone of a kind, and its phase."""
    place, event = np.arange(size), int(rng.uniform(0.2, 0.8) * size)
    frequency, height, jump = np.full(size, centre), np.full(size, amplitude), 0.0
    if kind == "drift":
        frequency = centre * (1.0 + rng.uniform(-0.1, 0.1) * (place / size - 0.5))
    if kind == "decay":
        height = amplitude * np.exp(-place / size * rng.uniform(0.5, 8.0))
    if kind == "frequency step":
        frequency = np.where(place < event, centre, centre * (1.0 + rng.uniform(-0.05, 0.05)))
    if kind == "amplitude step":
        height = np.where(place < event, amplitude, amplitude * rng.uniform(0.0, 2.0))
    if kind == "phase step":
        jump = np.deg2rad(rng.uniform(-90.0, 90.0))
    phase = rng.uniform(0.0, 2.0 * np.pi) + 2.0 * np.pi * np.cumsum(frequency) + jump * (place >= event)
    return Tone(frequency, height, event if kind.endswith("step") else -1), phase


def could_be_right(signal: Signal, places: np.ndarray) -> np.ndarray:
    """Return whether a row could be right for each tone and place, shape (tones, places)."""
    cuts = np.unique([0, signal.samples.size, *signal.events])
    possible = np.zeros((len(signal.tones), places.size), bool)
    for j, tone in enumerate(signal.tones):
        for r, place in enumerate(places):
            after = min(int(np.searchsorted(cuts, place, side="right")), cuts.size - 1)
            low, high = cuts[after - 1], cuts[after]
            length, frequency = high - low, tone.frequency[place]
            if length < FAR:
                continue
            gain = abs(1.0 - signal.pole * np.exp(-2j * np.pi * frequency)) ** 2
            density = signal.noise**2 * (1.0 - signal.pole**2) / gain
            height = np.sqrt(np.mean(tone.amplitude[low:high] ** 2))
            off_middle = 1.0 + 15.0 * (2.0 * abs(place - 0.5 * (low + high)) / length) ** 2
            bound = np.sqrt(24.0 * density * off_middle / (height**2 * length**3)) / (2.0 * np.pi)
            others = [abs(other.frequency[place] - frequency) * length for other in signal.tones if other is not tone]
            there = tone.amplitude[place] > 0.5 * height and height > AMPLITUDES * np.sqrt(2.0 * density / length)
            possible[j, r] = bound < USUAL_ACCURACY * frequency and min(others, default=np.inf) > BINS and there
    return possible


def count_rows(signal: Signal, found: Track) -> tuple[int, int, int, int]:
    """Return the numbers of valid rows and of wrong ones, of rows that could be right, and of those valid and right."""
    places = np.minimum(np.round(found.t).astype(int), signal.samples.size - 1)
    possible = could_be_right(signal, places)
    valid = wrong = 0
    hit = np.zeros_like(possible)
    for r, place in enumerate(places):
        truth = np.array([tone.frequency[place] for tone in signal.tones])
        for k in np.flatnonzero(found.valid[r] & np.isfinite(found.omega[r])):
            frequency, error = found.omega[r, k] / (2.0 * np.pi), found.error[r, k] / (2.0 * np.pi)
            right = np.abs(truth - frequency) <= max(ERRORS * error, USUAL_ACCURACY * frequency)
            valid += 1
            wrong += not right.any()
            hit[right, r] = True
    return valid, wrong, int(possible.sum()), int((possible & hit).sum())


def honesty(signals: int, seed: int, show: bool) -> None:
    """Print the table of random signals."""
    print(f"{'requested':12} {'valid rows':>10} {'wrong':>7} {'':8} {'could be right':>14} {'valid of them':>13}")
    for name, more in (("one fewer", -1), ("as many", 0), ("two more", 2), ("auto", None)):
        total = np.zeros(4, int)
        for k in range(signals):
            signal = random_signal(np.random.default_rng([seed, k]))
            asked = None if more is None else max(0, len(signal.tones) + more)
            every = (signal.samples.size - 1.0) / (ROWS - 1)
            try:
                found = track(Recorded(signal.samples, 1.0), asked, every=every)
            except DataError:
                places = np.arange(0.0, signal.samples.size - 0.5, every).astype(int)
                total[2] += int(could_be_right(signal, places).sum())
                continue
            one = count_rows(signal, found)
            total += one
            if show and one[1]:
                print(f"   signal {k}: {one[1]} of {one[0]} valid rows are wrong")
        share = f"({100 * total[1] / max(1, total[0]):.2f} %)"
        hits = "-" if more == -1 else f"{100 * total[3] / max(1, total[2]):.1f} %"
        could = "-" if more == -1 else str(total[2])
        print(f"{name:12} {total[0]:10} {total[1]:7} {share:8} {could:>14} {hits:>13}", flush=True)


def named_cases(records: int, seed: int) -> None:
    """Print the table of the named cases: rows of some records of each, at 1 kHz."""
    print(f"\n{'named case':34} {'rows':>6} {'valid':>7} {'wrong':>6}")
    for name, seconds, tones, make in NAMED:
        total = np.zeros(3, int)
        for k in range(records):
            rng = np.random.default_rng([seed, 11, k])
            t = np.arange(int(seconds * RATE)) / RATE
            signal, truth = make(t, rng)
            try:
                found = track(Recorded(signal, 1.0 / RATE), tones, every=seconds / ROWS)
            except DataError:
                continue
            valid, error = found.valid, found.error / (2.0 * np.pi)
            off = np.abs(found.omega[:, :, None] / (2.0 * np.pi) - np.asarray(truth)).min(axis=2)
            total += (valid.size, valid.sum(), (valid & (off > np.maximum(0.02, ERRORS * error))).sum())
        print(f"{name:34} {total[0]:6} {total[1]:7} {total[2]:6}", flush=True)


def _tone(t: np.ndarray, rng: np.random.Generator, hertz: float) -> np.ndarray:
    return np.asarray(np.cos(2.0 * np.pi * hertz * t + rng.uniform(0.0, 2.0 * np.pi)))


def _noisy(samples: np.ndarray, rng: np.random.Generator, deviation: float) -> np.ndarray:
    return samples + deviation * rng.standard_normal(samples.size)


def _weak(t: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, tuple[float, ...]]:
    return _noisy(_tone(t, rng, 60.0) + 0.1 * _tone(t, rng, 85.0), rng, 0.01), (60.0, 85.0)


def _close(t: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, tuple[float, ...]]:
    return _noisy(_tone(t, rng, 30.0) + _tone(t, rng, 30.5), rng, 0.01), (30.0, 30.5)


def _stepping(t: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, tuple[float, ...]]:
    phase = rng.uniform(0.0, 2.0 * np.pi) + np.deg2rad(10.0) * (t > rng.uniform(0.2, 0.8) * t[-1])
    return _noisy(np.cos(2.0 * np.pi * 50.0 * t + phase), rng, 0.01), (50.0,)


def _decaying(t: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, tuple[float, ...]]:
    return _noisy(np.exp(-5.0 * t / t[-1]) * _tone(t, rng, 50.0), rng, 0.01), (50.0,)


def _spike(t: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, tuple[float, ...]]:
    samples = _noisy(_tone(t, rng, 50.0), rng, 0.01)
    samples[rng.integers(t.size)] = 1e6
    return samples, (50.0,)


def _short(t: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, tuple[float, ...]]:
    return _noisy(_tone(t, rng, 42.0), rng, np.sqrt(0.5 / 10.0)), (42.0,)


RATE = 1000.0
#: Name, seconds, requested number of tones, and a function: the samples and the true frequencies [Hz].
NAMED = (
    ("85 Hz at a tenth, 60 Hz, tones=1", 8.0, 1, _weak),
    ("30 and 30.5 Hz, 8 s, tones=1", 8.0, 1, _close),
    ("30 and 30.5 Hz, 2 s, tones=1", 2.0, 1, _close),
    ("phase step of 10 degrees", 8.0, 1, _stepping),
    ("decay by 43 dB", 8.0, 1, _decaying),
    ("one spike of 1e6", 8.0, 1, _spike),
    ("42 Hz at 10 dB in 4 s", 4.0, 1, _short),
)


#: Frequencies of clean tones [rad/sample]; the last two are four bins apart.
SIZE = 2000
CLEAN = {"1": (0.6,), "2": (0.6, 1.1), "3": (0.6, 1.1, 1.9), "2 near": (0.6, 0.6 + 8.0 * np.pi / SIZE)}


def efficiency(records: int, seed: int) -> None:
    """Print the table of clean tones."""
    print(f"\n{'':18}{'middle row':>21}{'frequencies':>23}{'amplitudes':>23}")
    print(f"{'tones':6} {'noise':10} {'covered':>8} {'rmse / bound':>12}" + f" {'error / scatter':>15} covered" * 2)
    for noise, pole, deviation in (("white", 0.0, 0.0707), ("white 40 dB", 0.0, 0.00707), ("AR .9", 0.9, 0.0707)):
        for name, tones in CLEAN.items():
            omega, rows = np.array(tones), []
            gain = np.abs(1.0 - pole * np.exp(-1j * omega)) ** 2
            bound = np.sqrt(24.0 * deviation**2 * (1.0 - pole**2) / gain / SIZE**3)
            for k in range(records):
                rng = np.random.default_rng([seed, 7, k])
                raw = lfilter([np.sqrt(1.0 - pole**2)], [1.0, -pole], rng.standard_normal(SIZE + 200))[200:]
                phase = rng.uniform(0.0, 2.0 * np.pi, 3)[: omega.size]
                y = np.cos(np.outer(np.arange(SIZE), omega) + phase).sum(axis=1) + deviation * raw
                found = track(Recorded(y, 1.0), omega.size, every=SIZE / 20.0)
                if np.isfinite(found.omega[10]).all():
                    table = [
                        (2.0 * np.pi * each.standard_error_hz, each.omega, each.amplitude_error, each.amplitude)
                        for each in summarise(found)
                    ]
                    rows.append([found.error[10], found.omega[10], *np.transpose(table)])
            errors, values = np.array(rows)[:, ::2], np.array(rows)[:, 1::2]
            off = values - np.stack((omega, omega, np.ones_like(omega)))
            covered = 100.0 * (np.abs(off) < 1.96 * errors).mean(axis=(0, 2))
            ratio = 1.0 / np.sqrt(np.mean((off / np.median(errors, axis=0)) ** 2, axis=(0, 2)))
            rmse = np.sqrt(np.mean((off[:, 0] / bound) ** 2))
            cells = "".join(f" {ratio[k]:15.3f} {covered[k]:6.1f}%" for k in (1, 2))
            print(f"{name:6} {noise:11} {covered[0]:6.1f}% {rmse:12.3f}{cells}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--signals", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--show", action="store_true", help="name the signals with wrong rows")
    given = parser.parse_args()
    began = time.process_time()
    honesty(given.signals, given.seed, given.show)
    named_cases(max(1, given.signals // 20), given.seed)
    efficiency(max(1, given.signals // 4), given.seed)
    print(f"{time.process_time() - began:.0f} CPU s")


if __name__ == "__main__":
    main()
