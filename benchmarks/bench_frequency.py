"""Samples per second of the frequency estimators: whole records, single samples, and plain numpy for comparison."""

from _timing import cpu, least

import numpy as np

from ctid_cli.frequency.delay_regression import delay_table
from ctid_cli.frequency.drem import DremFiniteTime, DremGradient, DremWindow
from ctid_cli.frequency.restarting_least_squares import RestartingLeastSquares

INTERVAL = 0.001
SAMPLES = 200_000
REPEATS = 7
OMEGA = {2: np.array([2.0, 3.0]), 5: np.array([1.0, 2.0, 3.0, 4.2, 5.5])}
#: Required samples per second.
TARGETS = {2: 1e6, 5: 3e5}


def signal(n, count=SAMPLES):
    t = INTERVAL * np.arange(count)
    return np.sin(np.outer(t, OMEGA[n]) + np.arange(n)).sum(axis=1)


def estimators(n):
    h, d = (0.7, 0.4) if n == 2 else (0.4, 0.3)
    epsilon = 1.0 if n == 2 else 1e-2
    return (
        ("drem_gradient", DremGradient(tones=n, h=h, d=d, epsilon=epsilon)),
        ("drem_finite_time", DremFiniteTime(tones=n, h=h, d=d, epsilon=epsilon)),
        ("drem_window", DremWindow(tones=n, h=h, d=d, memory=4.0)),
        ("restarting, no prefilter", RestartingLeastSquares(tones=n, h=h)),
        ("restarting, prefilter of 1 s", RestartingLeastSquares(tones=n, h=h, prefilter=1.0)),
        ("total least squares", RestartingLeastSquares(tones=n, h=h, solution="total_least_squares")),
    )


def numpy_finite_time(y, n, h, d, gain):
    """Compute the finite-time recursion for n tones, sample by sample with numpy, including frequencies."""
    table, lag, spacing = delay_table(n), round(h / INTERVAL), round(d / INTERVAL)
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
        for name, options in estimators(n):
            [seconds] = least(REPEATS, lambda options=options, y=y: options.track(y, INTERVAL))
            error = np.abs(options.track(y, INTERVAL).frequencies[-1] - OMEGA[n]).max()
            online = options.start(INTERVAL)
            [each] = least(3, lambda online=online, y=y: [online.update(sample) for sample in y[:1000]])
            print(f"{name:28}{n:3d}{SAMPLES / seconds:15.3g}{TARGETS[n]:10.0e}{1e3 * each:10.1f} us{error:10.1e}")
        count = 20_000
        h, d = (0.7, 0.4) if n == 2 else (0.4, 0.3)
        seconds, _ = cpu(numpy_finite_time, y[:count], n, h, d, 1.0)
        compiled = DremFiniteTime(tones=n, h=h, d=d, epsilon=1.0)
        [ours] = least(REPEATS, lambda compiled=compiled, y=y[:count]: compiled.track(y, INTERVAL))
        ratio = seconds / ours
        print(f"{'finite time, numpy':28}{n:3d}{count / seconds:15.3g}   drem_finite_time is {ratio:.0f} times as fast")


if __name__ == "__main__":
    main()
