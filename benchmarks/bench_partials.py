"""Partials of recorded notes: those of an independent fit, and the number of them in a track.

    python benchmarks/bench_partials.py guitar_E2.csv [more.csv] [--windows 4] [--again] [--made] [--peaks]

In windows of one second, exponentially growing chirps are fitted by Gauss-Newton steps with dense linear algebra.
Peaks of the residual are added if they are 10 dB above the noise floor, a running median. A partial that is 10 dB above
it in the end is kept if a tone of the track has a row within .3 Hz, and valid if that row is: at the middle of the
window, or anywhere in it. No two valid readings of one row should be within one bin of their windows. A window takes up
to two minutes.

The fit itself is uncertain: ``--again`` counts the partials that it finds again in a window that begins 2 ms later, and
``--made`` those that it finds in white noise, and in twelve harmonics that decay in two stages, each of one frequency.

``--peaks`` compares with the peaks of a periodogram instead: its window has side lobes of -92 dB, and separates lines
that are 4 Hz apart.
"""

import argparse

import numpy as np
from scipy.ndimage import median_filter
from scipy.signal import find_peaks, get_window

from ctid_cli.signals.sampled_signal import read_sampled_signal
from ctid_cli.tones.track import track

#: Least power above the noise floor [dB], bins of the running median and on either side of an added peak that wait for
#: the next round, peaks added at once, and points of the periodogram for each bin.
LEAST_DB, FLOOR_BINS, WAITING, TOGETHER, PADDING = 10.0, 51, 10, 8, 4
ROUNDS, STEPS = 25, 10
MOST_GROWTH, MOST_BEND, LONGEST_STEP = 4.0, 8.0, 2.0
KEPT_HZ, CLOSE_HZ, STRONG_DB = 0.3, 2.0, 20.0
EVERY = 0.005
#: Shift of the windows of ``--again`` [s], and number, fundamental [Hz] and rate of the harmonics of ``--made``.
SHIFT = 0.002
HARMONICS, FUNDAMENTAL, RATE = 12, 147.0, 8000
#: Levels that ``--peaks`` counts [dB], least prominence of a peak [dB], and bins of the running median.
LEVELS, PROMINENCE, PEAK_FLOOR = (30.0, 20.0, 10.0), 6.0, 101


def model(u, parameters):
    """Return the sum of the tones ``exp(g u) (a cos + b sin)(w u + c u^2)``, and its derivatives, shape (N, 5 n)."""
    a, b, g, w, c = parameters
    angle, grown = np.outer(u, w) + np.outer(u**2, c), np.exp(np.outer(u, g))
    cosine, sine = grown * np.cos(angle), grown * np.sin(angle)
    value, turned = a * cosine + b * sine, b * cosine - a * sine
    u = u[:, None]
    return value.sum(axis=1), np.concatenate((cosine, sine, u * value, u * turned, u**2 * turned), axis=1)


def fit(y, parameters):
    """Return fitted parameters, shape (5, n), and the residual."""
    u = np.linspace(-1.0, 1.0, y.size)
    value, slopes = model(u, parameters)
    left, damping = y - value, 1e-3
    for _ in range(STEPS):
        gram, right = slopes.T @ slopes, slopes.T @ left
        while damping < 1e6:
            step = np.linalg.solve(gram + damping * np.diag(np.diag(gram) + 1e-30), right).reshape(5, -1)
            trial = parameters + step
            trial[2] = np.clip(trial[2], -MOST_GROWTH, MOST_GROWTH)
            trial[4] = np.clip(trial[4], -MOST_BEND, MOST_BEND)
            value, new = model(u, trial)
            rest = y - value
            if np.abs(step[3]).max() < LONGEST_STEP and rest @ rest < left @ left:
                break
            damping *= 10.0
        else:
            break
        gained = 1.0 - (rest @ rest) / (left @ left)
        parameters, slopes, left, damping = trial, new, rest, max(0.1 * damping, 1e-9)
        if gained < 1e-6:
            break
    return parameters, left


def noise_floor(left, bins):
    """Return the noise floor of a periodogram at some places [bins]."""
    power = np.abs(np.fft.rfft(left)) ** 2 / left.size
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(power, FLOOR_BINS // 2, mode="reflect"), FLOOR_BINS)
    return np.interp(bins, np.arange(power.size), np.median(windows, axis=1) / np.log(2.0))


def joining(left, there):
    """Return the strongest peaks [bins] that are 10 dB above the noise floor, not within a bin of given ones."""
    power = np.abs(np.fft.rfft(left, PADDING * left.size)) ** 2 / left.size
    bins = np.arange(power.size) / PADDING
    ratio = power / noise_floor(left, bins)
    ratio[bins < 2.0] = 0.0
    for place in there:
        ratio[np.abs(bins - place) <= 1.0] = 0.0
    found = []
    while len(found) < TOGETHER and ratio.max() > 10.0 ** (0.1 * LEAST_DB):
        found.append(bins[ratio.argmax()])
        ratio[np.abs(bins - found[-1]) <= WAITING] = 0.0
    return np.array(found)


def partials(y):
    """Return frequencies [bins] and powers over the noise floor [dB] of the partials of a window."""
    y = y - y.mean()
    left, parameters = y, np.zeros((5, 0))
    for _ in range(ROUNDS):
        found = joining(left, parameters[3] / np.pi)
        if not found.size:
            break
        new = np.zeros((5, found.size))
        new[3] = np.pi * found
        parameters, left = fit(y, np.concatenate((parameters, new), axis=1))
    bins, twice = parameters[3] / np.pi, 2.0 * parameters[2] + 1e-9
    mean_square = 0.5 * (parameters[0] ** 2 + parameters[1] ** 2) * np.sinh(twice) / twice
    decibels = 10.0 * np.log10(mean_square * y.size / 2.0 / noise_floor(left, bins))
    return bins[decibels > LEAST_DB], decibels[decibels > LEAST_DB]


def readings_twice(hertz, valid, window):
    """Return the number of valid readings of one row within one bin of another."""
    count = 0
    for row, here in enumerate(valid):
        order = np.flatnonzero(here)[np.argsort(hertz[row, here])]
        shorter = np.minimum(window[row, order[1:]], window[row, order[:-1]])
        count += int((np.diff(hertz[row, order]) * shorter < 1.0).sum())
    return count


def found_again(record, begin, size, bins):
    """Return which partials the fit finds again within .3 Hz in a window that is shifted by 2 ms."""
    shift = round(SHIFT / record.interval)
    shifted = begin - shift if begin else shift
    again, _ = partials(record.samples[shifted : shifted + size])
    return (np.abs(bins[:, None] - again) < KEPT_HZ).any(axis=1)


def made_records(records):
    """Print the numbers of partials of white noise, and of harmonics that decay in two stages."""
    rng, t = np.random.default_rng(20261128), np.arange(RATE) / RATE
    envelope = 0.7 * np.exp(-t / 0.1) + 0.3 * np.exp(-t / 0.8)
    for name, amplitude, noise in (("white noise", 0.0, 1.0), (f"{HARMONICS} harmonics", 1.0, 1e-3)):
        for _ in range(records):
            phases = rng.uniform(0.0, 6.0, HARMONICS)
            orders = np.arange(1, HARMONICS + 1)
            tones = np.cos(2.0 * np.pi * FUNDAMENTAL * np.outer(t, orders) + phases) / orders
            _, decibels = partials(amplitude * envelope * tones.sum(axis=1) + noise * rng.standard_normal(t.size))
            strong = int((decibels >= STRONG_DB).sum())
            print(f"{name}: {strong} partials of 20 dB, {decibels.size - strong} of 10 to 20 dB", flush=True)


def compare(file, windows, again):
    """Print, for each window of a record, the partials of the fit and those kept by the track."""
    record = read_sampled_signal(file).in_seconds()
    found = track(record, every=EVERY)
    hertz = found.omega / (2.0 * np.pi)
    twice = readings_twice(hertz, found.valid, found.window)
    print(f"{file}: {hertz.shape[1]} tones, {int(found.valid.sum())} valid readings, {twice} of them twice")
    size = round(1.0 / record.interval)
    for begin in np.linspace(0, record.samples.size - size, windows).astype(int):
        bins, decibels = partials(record.samples[begin : begin + size])
        repeated = found_again(record, begin, size, bins) if again else None
        apart = np.abs(bins[:, None] - bins) + np.where(np.eye(bins.size), np.inf, 0.0)
        instants = found.t - begin * record.interval
        inside, middle = (instants >= 0.0) & (instants <= 1.0), int(np.abs(instants - 0.5).argmin())
        near = np.abs(hertz[:, :, None] - bins) < KEPT_HZ
        right = near & found.valid[:, :, None]
        kept_in, valid_in = (each[inside].any(axis=(0, 1)) for each in (near, right))
        kept_at, valid_at = (each[middle].any(axis=0) for each in (near, right))
        for name, which in (("20 dB", decibels >= STRONG_DB), ("10 to 20 dB", decibels < STRONG_DB)):
            close = which & ~kept_in & (apart.min(axis=1) < CLOSE_HZ)
            kept = f"kept {(which & kept_in).sum():3} ({(which & kept_at).sum():3} at the middle)"
            valid = f"valid {(which & valid_in).sum():3} ({(which & valid_at).sum():3})"
            lost = f"lost within {CLOSE_HZ:g} Hz of another {close.sum():3}"
            lost += "" if repeated is None else f"; found again {(which & repeated).sum():3}"
            start = f"from {begin * record.interval:.2f} s"
            print(f"  {start}, {name:11}: {which.sum():3} partials, {kept}, {valid}; {lost}", flush=True)


def compare_peaks(file, windows):
    """Print the peaks of periodograms of one second, and those within .3 and 1 Hz of a row of the track there."""
    record = read_sampled_signal(file).in_seconds()
    found = track(record)
    hertz, size = found.omega / (2.0 * np.pi), round(1.0 / record.interval)
    counts = np.zeros((len(LEVELS), 3), int)
    for begin in np.linspace(0, record.samples.size - size, windows).astype(int):
        y = record.samples[begin : begin + size]
        power = np.abs(np.fft.rfft((y - y.mean()) * get_window("blackmanharris", size), PADDING * size)) ** 2
        decibels = 10.0 * np.log10(power * np.log(2.0) / median_filter(power, PADDING * PEAK_FLOOR))
        places, _ = find_peaks(decibels, height=LEVELS[-1], prominence=PROMINENCE)
        begins = begin * record.interval
        there = hertz[(found.t >= begins) & (found.t <= begins + 1.0)]
        off = np.nanmin(np.abs(there[:, :, None] - places / (PADDING * size * record.interval)), axis=(0, 1))
        level = np.argmax(decibels[places] >= np.array(LEVELS)[:, None], axis=0)
        for k in range(len(LEVELS)):
            here = off[level == k]
            counts[k] += [here.size, (here < KEPT_HZ).sum(), (here < 1.0).sum()]
    for low, (all_, kept, near) in zip(LEVELS, counts, strict=True):
        print(f"{file}, from {low:g} dB: {all_} peaks, {kept} with a row within {KEPT_HZ} Hz, {near} within 1 Hz")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="*")
    parser.add_argument("--windows", type=int, default=4)
    parser.add_argument("--again", action="store_true", help="count the partials that a shifted window has too")
    parser.add_argument("--made", action="store_true", help="count the partials of made records")
    parser.add_argument("--peaks", action="store_true", help="compare with the peaks of a periodogram")
    given = parser.parse_args()
    if given.made:
        made_records(2)
    for file in given.files:
        if given.peaks:
            compare_peaks(file, given.windows)
        else:
            compare(file, given.windows, given.again)


if __name__ == "__main__":
    main()
