"""Search for the delay without a start, compared with least squares started from many delays.

Without arguments it uses simulated records, otherwise regularly sampled CSV files with columns t, u, y:

python benchmarks/bench_measured.py record.csv --delay 0:2 --poles 1 2
python benchmarks/bench_measured.py record.csv --delay 0:1 --samples 500 --centre
"""

import argparse

from _timing import cpu, least

import numpy as np
from scipy import linalg, optimize, signal

from ctid_cli.estimators.delay_profile import DelayProfile
from ctid_cli.estimators.svf import Svf
from ctid_cli.filtering.simulate import simulate
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.excitation import Prbs, Step
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.measurement import read_record
from ctid_cli.signals.noise import WhiteNoise
from ctid_cli.signals.record import Record

TARGET = 10
#: Largest relative excess of our cost.
EXCESS = 1e-6
#: Repetitions of our fit; the baseline is slow enough for one.
REPEATS = 7


def exact_zoh(a, b, delay, interval, u):
    """Return the exact response to the held input at the samples: a difference equation for the delayed output."""
    dynamics, gain, output, _ = signal.tf2ss(b, a)
    shift = int(np.ceil(delay / interval))
    inside = shift * interval - delay
    n = dynamics.shape[0]
    block = np.zeros((n + 1, n + 1))
    block[:n, :n], block[:n, n:] = dynamics, gain
    step, part = linalg.expm(block * interval), linalg.expm(block * inside)
    row = output @ part[:n]
    numerator, denominator = signal.ss2tf(step[:n, :n], step[:n, n:], row[:, :n], row[:, n:])
    response = signal.lfilter(numerator[0], denominator, u)
    return np.concatenate((np.zeros(shift), response))[: u.size]


def with_lsim(a, b, delay, interval, u):
    """Return the usual simulation: the mean of the delayed input over each interval into ``scipy.signal.lsim``."""
    t = interval * np.arange(u.size)
    edges = interval * np.arange(u.size + 1)
    integral = np.concatenate(([0.0], np.cumsum(u) * interval))
    delayed = np.diff(np.interp(np.append(t, t[-1] + interval) - delay, edges, integral)) / interval
    return signal.lsim((b, a), delayed, t, interp=False)[1]


SIMULATIONS = {"exact": exact_zoh, "scipy.signal.lsim": with_lsim}


def multi_start(record, poles, bounds, delays, simulation, zeros=0):
    """Return coefficients and delay of the lowest cost over starts at some delays."""
    u, interval = record.input.values, record.interval

    def residuals(theta):
        return record.y - simulation(np.append(1.0, theta[:poles]), theta[poles:-1], theta[-1], interval, u)

    low = [0.0] * poles + [-np.inf] * (zeros + 1) + [bounds[0]]
    high = [np.inf] * (poles + zeros + 1) + [bounds[1]]
    best = None
    for delay in delays:
        start = np.append(list(Svf(poles, zeros, delay=float(delay)).fit(record).parameters.values()), delay)
        start[:poles] = np.maximum(start[:poles], 1e-6)
        found = optimize.least_squares(
            residuals, start, bounds=(low, high), x_scale="jac", ftol=1e-10, xtol=1e-10, gtol=1e-10, max_nfev=50
        )
        if best is None or found.cost < best.cost:
            best = found
    return best.x


def exact_cost(record, poles, theta):
    model = TransferFunction(theta[poles:-1], np.append(1.0, theta[:poles]), theta[-1])
    return float(np.mean((record.y - simulate(model, record.input, record.t)) ** 2))


def compare(name, record, poles, bounds, starts, names):
    estimator = DelayProfile(poles, 0, bounds)
    [ours] = least(REPEATS, lambda: estimator.fit(record))
    theta = np.array(list(estimator.fit(record).parameters.values()))
    cost = exact_cost(record, poles, theta)
    print(f"{name:24}{poles:6}  {'delay_profile':28}{'':8}{ours:9.3f}{'1':>7}{cost:16.9g}{'':13}{theta[-1]:10.4f}")
    for simulation in names:
        for count in starts:
            inner = np.linspace(*bounds, count + 2)[1:-1]  # a start on a bound would be moved off it anyway
            seconds, found = cpu(multi_start, record, poles, bounds, inner, SIMULATIONS[simulation])
            other = exact_cost(record, poles, found)
            worse = cost / other - 1.0
            verdict = "" if worse <= EXCESS else "  ours is worse"
            print(
                f"{name:24}{poles:6}  {simulation:28}{count:8}{seconds:9.3f}{seconds / ours:7.1f}{other:16.9g}"
                f"{worse:+13.1e}{found[-1]:10.4f}{verdict}"
            )


def simulated(system, interval, samples, excitation, seed):
    rng = np.random.default_rng(seed)
    t = interval * np.arange(samples)
    applied = excitation.generate(t, rng)
    x = simulate(system, applied, t)
    return Record(t, x + WhiteNoise(snr_db=15.0).generate(x, rng), HeldSignal(t, applied.at(t)))


def read(path, samples, centre):
    whole = read_record(path)
    t, u, y = whole.t[:samples], whole.input.values[:samples], whole.y[:samples]
    if centre:
        u, y = u - u.mean(), y - np.nanmean(y)
    record = Record.from_arrays(t - t[0], u, y, name=path)
    if record.interval is None or not record.valid.all():
        raise SystemExit(f"{path}: the baseline needs a regular clock and no missing samples")
    return record


def main():
    parser = argparse.ArgumentParser(description="delay_profile against multi-start least squares")
    parser.add_argument("files", nargs="*", help="CSV files; none: simulated records")
    parser.add_argument("--delay", default="0:2", help="LOW:HIGH, least and greatest delay [s]")
    parser.add_argument("--poles", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--samples", type=int, help="use so many samples from the beginning")
    parser.add_argument("--centre", action="store_true", help="subtract the means")
    parser.add_argument(
        "--starts", type=int, nargs="+", help="delays of the baseline; default one per sampling interval"
    )
    parser.add_argument("--simulation", nargs="+", choices=list(SIMULATIONS), default=list(SIMULATIONS))
    options = parser.parse_args()
    if options.files:
        bounds = tuple(float(bound) for bound in options.delay.split(":"))
        records = [
            (path.rpartition("/")[2], read(path, options.samples, options.centre), options.poles, bounds)
            for path in options.files
        ]
    else:
        first_order = TransferFunction([2.0], [3.0, 1.0], 1.3)
        case1 = TransferFunction([2.0], [0.25, 0.7, 1.0], 8.0)
        records = [
            ("first order, step", simulated(first_order, 0.2, 400, Step(time=5.0), 1), [1], (0.0, 4.0)),
            ("first order, PRBS", simulated(first_order, 0.2, 1000, Prbs(9, 1.0), 1), [1], (0.0, 4.0)),
            ("case 1", simulated(case1, 0.05, 4000, Prbs(10, 0.05), 1), [2], (7.75, 8.25)),
        ]
    print(
        f"{'record':24}{'poles':>6}  {'method':28}{'starts':>8}{'CPU s':>9}{'ratio':>7}{'cost':>16}{'ours excess':>13}"
        f"{'delay s':>10}"
    )
    for name, record, poles, bounds in records:
        starts = options.starts or [int(np.ceil((bounds[1] - bounds[0]) / record.interval - 1e-9))]
        for n in poles:
            compare(name, record, n, bounds, starts, options.simulation)
    print(f"target: at least {TARGET} times faster, cost at most {EXCESS:g} relative above the baseline's")


if __name__ == "__main__":
    main()
