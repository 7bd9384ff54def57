"""Algorithm IV as printed, against a short independent transcription, and within its bounds on noise."""

import numpy as np
import pytest

from ctid_cli.errors import OptionError
from ctid_cli.estimation.common import Start
from ctid_cli.estimation.sampled_problem import with_stable_denominator
from ctid_cli.estimators.td_srivc import INNER_ITERATIONS
from ctid_cli.estimators.useful_redundancy import UsefulRedundancy
from ctid_cli.filtering.filter_set import FilterSet
from ctid_cli.filtering.simulate import simulate
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from tests.estimators.records import make_record

BOUNDS, FILTERS, BETA, BANDWIDTH, SVF_CUTOFF = (0.0, 15.0), 2, 3.0, 2.02, 1.0
TOLERANCE, LARGEST_STEP = 1e-3, 1.0


def plain(**more):
    options = {"bandwidth": BANDWIDTH, "filters": FILTERS, "beta": BETA, "svf_cutoff": SVF_CUTOFF, "variant": "plain"}
    return UsefulRedundancy(2, 0, BOUNDS, **options | {"max_delay_step": LARGEST_STEP} | more)


class Transcription:
    """Algorithms I, II and IV for two poles and no zero: signals as arrays, sums over them as matrix products."""

    def __init__(self, record):
        self.members = [lowpass.apply(record) for lowpass in FilterSet(BANDWIDTH, FILTERS, BETA).lowpasses]
        self.record = record
        self.used = record.t >= BOUNDS[1] - 1e-9

    def filtered(self, held, a, numerator, delay=0.0):
        return simulate(TransferFunction(numerator, a, delay), held, self.record.t)[self.used]

    def signals(self, record, a, b, delay):
        """Return p^2/A y of (7), the regressors (8), the instruments (9), the output error, and its slope (26)."""
        y = HeldSignal(record.t, record.y, "foh")
        slow, fast = (self.filtered(y, a, numerator) for numerator in ([1.0], [1.0, 0.0]))
        u = self.filtered(record.input, a, [1.0], delay)
        squared = np.polymul(a, a)
        x_slow, x_fast = (self.filtered(record.input, squared, b * np.array(n), delay) for n in ([1.0], [1.0, 0.0]))
        error = record.y[self.used] - b * u
        slope = b * self.filtered(record.input, a, [1.0, 0.0], delay)
        highest = record.y[self.used] - a[1] * fast - a[2] * slow
        return highest, np.array([-fast, -slow, u]), np.array([-x_fast, -x_slow, u]), error, slope

    def srivc(self, record, delay, theta=None):
        """Run algorithm I: coefficients, squared error and Gauss-Newton step of the delay, (26) and (27)."""
        if theta is None:
            highest, phi, *_ = self.signals(record, np.poly([-SVF_CUTOFF] * 2), 1.0, delay)
            theta = with_stable_denominator(np.linalg.solve(phi @ phi.T, phi @ highest), 2)
        for _ in range(INNER_ITERATIONS):
            highest, phi, psi, *_ = self.signals(record, np.append(1.0, theta[:2]), theta[2], delay)
            found = np.linalg.solve(psi @ phi.T, psi @ highest)
            change, power = psi.T @ (found - theta), np.sum((theta[2] * psi[2]) ** 2)
            theta = with_stable_denominator(found, 2)
            if change @ change <= TOLERANCE**2 * power:
                break
        _, _, psi, error, slope = self.signals(record, np.append(1.0, theta[:2]), theta[2], delay)
        within = psi.T @ np.linalg.lstsq(psi.T, slope, rcond=None)[0]
        return theta, error @ error, -(slope @ error) / (slope @ slope - slope @ within)

    def descend(self, record, delay):
        """Run algorithm II without step 3."""
        theta, cost, step = self.srivc(record, delay)
        for _ in range(10):
            step, trial = np.clip(step, -LARGEST_STEP, LARGEST_STEP), (theta, np.inf, 0.0)
            while True:
                while not BOUNDS[0] <= delay + step <= BOUNDS[1]:
                    step /= 2
                if abs(step) <= 1e-5 * (BOUNDS[1] - BOUNDS[0]):
                    return delay
                trial = self.srivc(record, delay + step, theta)
                if trial[1] < cost:
                    break
                step /= 2
            before, delay = cost, delay + step
            theta, cost, step = trial
            if 1 - cost / before < TOLERANCE:
                return delay
        return delay

    def reference_cost(self, delay):
        """Return (45)."""
        outputs = [member.y[self.used] for member in self.members]
        errors = [self.srivc(member, delay)[1] for member in self.members]
        return np.mean([100 * np.sqrt(e) / np.linalg.norm(y - y.mean()) for e, y in zip(errors, outputs, strict=True)])

    def rounds(self, delay):
        """Run algorithm IV, step 2: incumbents, their J0, and the ends of all paths of each round."""
        trajectory, ends = [(delay, self.reference_cost(delay))], []
        while True:
            ends.append([self.descend(member, delay) for member in self.members])
            costs = [self.reference_cost(end) for end in ends[-1]]
            before, delay = delay, ends[-1][int(np.argmin(costs))]
            trajectory.append((delay, min(costs)))
            if abs(delay - before) < TOLERANCE * delay:
                return trajectory, ends


@pytest.mark.parametrize(("start", "snr_db"), [(3.0, None), (9.5, 15)])
def test_rounds_are_those_of_the_transcription(start, snr_db):
    record = make_record(snr_db=snr_db, n=600, clock_period=0.5)
    trajectory, ends = Transcription(record).rounds(start)
    fit = plain().fit(record, Start(start))
    assert len(trajectory) > 2
    found = [(visit.point, visit.cost) for visit in fit.search.trajectory]
    np.testing.assert_allclose(found, trajectory, rtol=1e-6, atol=1e-6)
    visits = [visit.point for visit in fit.search.visits[1:]]
    np.testing.assert_allclose(visits, np.concatenate(ends), rtol=1e-6)
    assert fit.model.delay == pytest.approx(8.0, abs=1e-4 if snr_db is None else 0.1)


def test_longest_step_holds_for_the_guarded_variant_too():
    record = make_record(snr_db=5, n=900)
    steps = {}
    for longest in (0.5, None):
        fit = plain(variant="guarded", max_delay_step=longest).fit(record, Start(2.0))
        steps[longest] = max(np.abs(np.diff(path.delays)).max(initial=0.0) for path in fit.paths)
    assert steps[0.5] == pytest.approx(0.5, rel=1e-12)
    assert 0.5 < steps[None] <= 5.0 * (1 + 1e-12)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"variant": "printed"}, "variant must be 'plain' or 'guarded', not 'printed'"),
        ({"max_delay_step": 0.0}, r"max_delay_step must be a positive number \[s\], not 0.0"),
    ],
)
def test_impossible_options_are_refused(more, message):
    with pytest.raises(OptionError, match=message):
        plain(**more)
