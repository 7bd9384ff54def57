"""Fit of a model with its delay from one start, against nonlinear least squares with other tools' simulations.

All start at the same delay and coefficients, fit the same samples, and report the cost of their result, computed by the
same exact simulation.
"""

from _timing import cpu, least

import control
import numpy as np
from scipy import optimize, signal

from ctid_cli.estimation.common import Start
from ctid_cli.estimators.svf import Svf
from ctid_cli.estimators.td_srivc import TdSrivc
from ctid_cli.filtering.simulate import simulate
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.excitation import Prbs
from ctid_cli.signals.noise import WhiteNoise
from ctid_cli.signals.record import Record

SYSTEM = TransferFunction([2], [0.25, 0.7, 1], 8.0)
BOUNDS = (0.0, 15.0)
START = 7.5
TARGET = 50
#: Step of the other tools' simulation if the clock of the record is irregular [s].
FINE_STEP = 0.01


def make_record(regular, n=4000):
    rng = np.random.default_rng(0)
    t = 0.05 * np.arange(n) if regular else np.concatenate(([0.0], np.cumsum(rng.uniform(0.01, 0.09, n - 1))))
    held = Prbs(stages=10, clock_period=0.05 if regular else 0.5).generate(t, rng)
    x = simulate(SYSTEM, held, t)
    return Record(t, x + WhiteNoise(snr_db=15).generate(x, rng), held)


def with_lsim(numerator, denominator, t, u):
    return signal.lsim((numerator, denominator), u, t, interp=False)[1]


def with_control(numerator, denominator, t, u):
    system = control.sample_system(control.tf(numerator, denominator), t[1] - t[0], "zoh")
    return control.forced_response(system, t, u).outputs


class LeastSquares:
    """Typical use of a general simulator: residuals as a function of coefficients and delay."""

    def __init__(self, record, simulator):
        self.record, self.simulator = record, simulator
        step = record.interval or FINE_STEP
        self.t = step * np.arange(int(np.ceil(record.t[-1] / step)) + 1)
        # The mean of the delayed input over each step, from its integral: smooth in the delay.
        edges = np.append(record.input.t, record.t[-1] + BOUNDS[1])
        integral = np.concatenate(([0.0], np.cumsum(record.input.values * np.diff(edges))))
        self.edges, self.integral = edges, integral
        self.step = step
        self.use = record.t >= BOUNDS[1]
        self.calls = 0

    def residuals(self, theta):
        self.calls += 1
        a1, a2, b0, delay = theta
        ends = np.append(self.t, self.t[-1] + self.step) - delay
        u = np.diff(np.interp(ends, self.edges, self.integral)) / self.step
        x = self.simulator([b0], [1.0, a1, a2], self.t, u)
        if self.record.interval is None:
            x = np.interp(self.record.t, self.t, x)
        return (self.record.y - x)[self.use]

    def solve(self, start):
        low, high = [0.0, 0.0, -np.inf, BOUNDS[0]], [np.inf, np.inf, np.inf, BOUNDS[1]]
        return optimize.least_squares(self.residuals, start, bounds=(low, high), x_scale="jac").x


def exact_cost(record, theta):
    x = simulate(TransferFunction([theta[2]], [1.0, theta[0], theta[1]], theta[3]), record.input, record.t)
    return float(np.mean((record.y - x)[record.t >= BOUNDS[1]] ** 2))


def main():
    print(f"{'clock':10}{'method':34}{'CPU ms':>10}{'ratio':>8}{'cost':>12}{'delay s':>10}{'simulations':>13}")
    for regular in (True, False):
        record = make_record(regular)
        clock = "regular" if regular else "irregular"
        estimator = TdSrivc(poles=2, zeros=0, delay_bounds=BOUNDS)
        [ours] = least(15, lambda e=estimator, r=record: e.fit(r, Start(START)))  # laying out the record included
        theta = np.array(list(estimator.fit(record, Start(START)).parameters.values()))
        print(f"{clock:10}{'td_srivc':34}{1e3 * ours:10.2f}{'1':>8}{exact_cost(record, theta):12.6f}{theta[3]:10.4f}")
        start = np.array([*Svf(2, 0, delay=START).fit(record).parameters.values(), START])
        for name, simulator in (("scipy.signal.lsim", with_lsim), ("python-control", with_control)):
            problem = LeastSquares(record, simulator)
            seconds, found = cpu(problem.solve, start)
            print(
                f"{clock:10}{'least_squares, ' + name:34}{1e3 * seconds:10.2f}{seconds / ours:8.0f}"
                f"{exact_cost(record, found):12.6f}{found[3]:10.4f}{problem.calls:13d}"
            )
    print(f"target: at least {TARGET} times faster at no higher cost")


if __name__ == "__main__":
    main()
