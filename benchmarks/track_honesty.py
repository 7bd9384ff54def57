"""Is a row of a track right that is called valid? Random signals, asked for too few, enough and too many tones.

    python benchmarks/track_honesty.py [--signals 1000] [--seed 1] [--show] [--method NAME]

Signals of 1000 to 8000 samples: none to five tones over 60 dB, a quarter of them 3 to 12 bins beside another, steady,
drifting, decaying or with a step of phase, frequency or amplitude, some with harmonics; white or coloured noise 10 to
60 dB below the strongest, some with spikes or a gap. A valid row is wrong if its frequency is off the nearest true one
by more than 3.3 of its standard errors and more than .001 of the frequency. A row could be right if the bound of Cramer
and Rao for the stretch between two events of the signal (rate of change unknown) is below the accuracy, its tone is no
weaker than six standard errors of its amplitude and three bins of the stretch from any other.

With ``--method`` rows of an online estimator are judged, as ``ctid track`` gives them.

Then: coverage of the standard errors and their size beside the bound, for one to three steady tones in white and
coloured noise.
"""

import argparse
import time
from typing import Any, NamedTuple

import numpy as np
from scipy.signal import lfilter

from ctid_cli.errors import DataError
from ctid_cli.frequency.automatic import choose_settings
from ctid_cli.frequency.estimator_rows import track_record
from ctid_cli.frequency.inputs import MOST_TONES
from ctid_cli.frequency.record_tones import follow_tones
from ctid_cli.frequency.record_track import USUAL_ACCURACY, RecordTrack
from ctid_cli.kinds import ONLINE

ROWS = 60
KINDS = ("steady", "steady", "steady", "drift", "decay", "phase step", "frequency step", "amplitude step")
FAR, ERRORS, AMPLITUDES, BINS = 64, 3.3, 6.0, 3.0


class Tone(NamedTuple):
    """A tone that is in a signal."""

    #: Frequency at each sample [1/sample].
    frequency: np.ndarray
    amplitude: np.ndarray
    #: Sample at which it steps; -1 if it does not.
    event: int


class Signal(NamedTuple):
    """A random signal and what it is made of."""

    samples: np.ndarray
    tones: list[Tone]
    #: Standard deviation of the noise, and its autoregressive coefficient.
    noise: float
    pole: float
    events: list[int]


def random_signal(rng: np.random.Generator) -> Signal:
    """One of the signals."""
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
    """A tone of a kind, and its phase."""
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
    """For each tone and place, shape (tones, places)."""
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


def judged(signal: Signal, track: RecordTrack) -> tuple[int, int, int, int]:
    """Valid rows, wrong ones; rows that could be right where all that could be are found, and how many are valid."""
    places = np.minimum(np.round(track.t).astype(int), signal.samples.size - 1)
    possible = could_be_right(signal, places)
    valid = wrong = 0
    hit, found = np.zeros_like(possible), np.zeros_like(possible)
    for r, place in enumerate(places):
        truth = np.array([tone.frequency[place] for tone in signal.tones])
        for k in np.flatnonzero(np.isfinite(track.omega[r])):
            frequency, error = track.omega[r, k] / (2.0 * np.pi), track.error[r, k] / (2.0 * np.pi)
            off = np.abs(truth - frequency)
            right = off <= max(ERRORS * error, USUAL_ACCURACY * frequency)
            found[right, r] = True
            if track.valid[r, k]:
                valid += 1
                wrong += not right.any()
                hit[right, r] = True
    # A row in which a tone that could be right was not asked for, or not found, does not count.
    complete = possible & (found | ~possible).all(axis=0)
    return valid, wrong, int(complete.sum()), int((complete & hit).sum())


def tracked(signal: Signal, tones: int | None, method: str | None) -> RecordTrack:
    """The track of a signal, without a method or with one."""
    every = (signal.samples.size - 1.0) / (ROWS - 1)
    if method is None:
        return follow_tones(signal.samples, 1.0, tones, every=every)[0]
    settings = choose_settings(signal.samples, 1.0, min(MOST_TONES, max(1, tones or 0)), method=method)
    return track_record(signal.samples, 1.0, settings, every=every)


def honesty(signals: int, seed: int, show: bool, method: str | None) -> None:
    """The table of the first question."""
    print(f"{'asked for':12} {'valid rows':>10} {'wrong':>7} {'':8} {'could be right':>14} {'valid of them':>13}")
    for name, more in (("one fewer", -1), ("as many", 0), ("two more", 2), *([] if method else [("auto", None)])):
        total = np.zeros(4, int)
        for k in range(signals):
            signal = random_signal(np.random.default_rng([seed, k]))
            asked = None if more is None else max(0, len(signal.tones) + more)
            try:
                track = tracked(signal, asked, method)
            except DataError:
                continue
            one = judged(signal, track.of_accuracy(None))
            total += one
            if show and one[1]:
                print(f"   signal {k}: {one[1]} of {one[0]} valid rows are wrong")
        share = f"({100 * total[1] / max(1, total[0]):.2f} %)"
        hits = f"{100 * total[3] / max(1, total[2]):.1f} %"
        print(f"{name:12} {total[0]:10} {total[1]:7} {share:8} {total[2]:14} {hits:>13}", flush=True)


def efficiency(records: int, seed: int) -> None:
    """The table of the second question: steady tones, N = 2000, 20 dB, errors in the middle of the record."""
    print(f"\n{'tones':5} {'noise':8} {'covered':>8} {'rmse / bound':>12}")
    size, omega = 2000, np.array([0.6, 1.1, 1.9])
    for pole in (0.0, 0.9):
        for tones in (1, 2, 3):
            off: list[Any] = []
            for k in range(records):
                rng = np.random.default_rng([seed, 7, k])
                raw = lfilter([np.sqrt(1.0 - pole**2)], [1.0, -pole], rng.standard_normal(size + 200))[200:]
                phase = rng.uniform(0.0, 2.0 * np.pi, 3)
                y = sum(np.cos(omega[j] * np.arange(size) + phase[j]) for j in range(tones)) + 0.0707 * raw
                track, _ = follow_tones(y, 1.0, tones, every=size / 2.0)
                if not np.isfinite(track.omega[1]).all():
                    continue
                density = 0.0707**2 * (1.0 - pole**2) / np.abs(1.0 - pole * np.exp(-1j * omega[:tones])) ** 2
                bound = np.sqrt(24.0 * density / size**3)
                error = track.omega[1] - omega[:tones]
                off += list(zip(np.abs(error) < 1.96 * track.error[1], error / bound, strict=True))
            inside, ratio = np.array(off).T
            name = "AR .9" if pole else "white"
            print(f"{tones:5} {name:8} {100 * inside.mean():7.1f}% {np.sqrt(np.mean(ratio**2)):12.3f}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--signals", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--show", action="store_true", help="name the signals with wrong rows")
    parser.add_argument("--method", choices=ONLINE, help="judge the rows of an online estimator")
    given = parser.parse_args()
    began = time.process_time()
    honesty(given.signals, given.seed, given.show, given.method)
    if given.method is None:
        efficiency(max(1, given.signals // 4), given.seed)
    print(f"{time.process_time() - began:.0f} CPU s")


if __name__ == "__main__":
    main()
