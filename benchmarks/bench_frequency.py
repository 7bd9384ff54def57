"""Samples per second of the frequency estimators: whole records, one sample at a time, and plain numpy beside them."""

from _timing import cpu, least

import numpy as np

from ctid_cli.frequency.drem_finite_time import DremFiniteTime
from ctid_cli.frequency.drem_gradient import DremGradient
from ctid_cli.frequency.drem_window import DremWindow
from ctid_cli.frequency.regression import delay_table
from ctid_cli.frequency.restarting_least_squares import RestartingLeastSquares

INTERVAL = 0.001
SAMPLES = 200_000
REPEATS = 7
OMEGA = {2: np.array([2.0, 3.0]), 5: np.array([1.0, 2.0, 3.0, 4.2, 5.5])}
#: Required samples per second.
TARGETS = {"drem": {2: 1e6, 5: 3e5}, "tracker, prefilter by FFT": {2: 2e6}}


def signal(n, count=SAMPLES):
    t = INTERVAL * np.arange(count)
    return np.sin(np.outer(t, OMEGA[n]) + np.arange(n)).sum(axis=1)


def estimators(n):
    h, d = (0.7, 0.4) if n == 2 else (0.4, 0.3)
    epsilon = 1.0 if n == 2 else 1e-2
    return (
        ("drem_gradient", DremGradient(tones=n, h=h, d=d, epsilon=epsilon), False),
        ("drem_finite_time", DremFiniteTime(tones=n, h=h, d=d, epsilon=epsilon), False),
        ("drem_window", DremWindow(tones=n, h=h, d=d, memory=4.0), False),
        ("tracker, no prefilter", RestartingLeastSquares(tones=n, h=h), False),
        ("tracker, prefilter by sums", RestartingLeastSquares(tones=n, h=h, prefilter=1.0), False),
        ("tracker, prefilter by FFT", RestartingLeastSquares(tones=n, h=h, prefilter=1.0), True),
        ("total least squares", RestartingLeastSquares(tones=n, h=h, solution="total_least_squares"), False),
    )


def numpy_finite_time(y, n, h, d, gain):
    """The finite-time recursion for n tones, sample by sample with numpy, frequencies included."""
    table, lag, spacing = delay_table(n).astype(float), round(h / INTERVAL), round(d / INTERVAL)
    lags, stack = lag * np.arange(2 * n + 1), spacing * np.arange(1, n + 1)
    rows = np.full((y.size, n + 1), np.nan)
    z, q, omega = np.zeros(n), np.zeros(n), np.full((y.size, n), np.nan)
    for k in range(2 * n * lag, y.size):
        rows[k] = table @ y[k - lags]
        matrix = rows[k - stack]
        if not np.isfinite(matrix).all():
            continue
        delta = np.linalg.det(matrix[:, :n])
        if delta != 0.0:
            ratio = np.linalg.solve(matrix[:, :n], matrix[:, n])
            m = -np.expm1(-gain * INTERVAL * delta**2)
            z += m * (ratio - z)
            q += m * (1.0 - q)
            roots = np.roots(np.concatenate(([1.0], z / q)))
            omega[k] = np.sort(np.arccos(np.clip(roots.real, -1.0, 1.0)) / h)
    return omega


def main():
    print(f"{'estimator':28}{'n':>3}{'samples/CPU s':>15}{'target':>10}{'one by one':>13}{'error':>10}")
    for n in (2, 5):
        y = signal(n)
        for name, options, fft in estimators(n):
            [seconds] = least(REPEATS, lambda options=options, fft=fft, y=y: options.start(INTERVAL).run(y, fft=fft))
            error = np.abs(options.start(INTERVAL).run(y, fft=fft).omega[-1] - OMEGA[n]).max()
            single = ""
            if not fft:
                tracker = options.start(INTERVAL)
                tracker.run(y[:10_000])
                [each] = least(3, lambda tracker=tracker, y=y: [tracker.update(sample) for sample in y[:1000]])
                single = f"{1e3 * each:.1f} us"
            target = TARGETS.get(name, TARGETS["drem"] if name in ("drem_gradient", "drem_finite_time") else {}).get(n)
            wanted = f"{target:.0e}" if target else "-"
            print(f"{name:28}{n:3d}{SAMPLES / seconds:15.3g}{wanted:>10}{single:>13}{error:10.1e}")
        count = 20_000
        h, d = (0.7, 0.4) if n == 2 else (0.4, 0.3)
        seconds, _ = cpu(numpy_finite_time, y[:count], n, h, d, 1.0)
        compiled = DremFiniteTime(tones=n, h=h, d=d, epsilon=1.0)
        [ours] = least(REPEATS, lambda compiled=compiled, y=y[:count]: compiled.start(INTERVAL).run(y))
        ratio = seconds / ours
        print(f"{'finite time, numpy':28}{n:3d}{count / seconds:15.3g}   drem_finite_time is {ratio:.0f} times as fast")


if __name__ == "__main__":
    main()
