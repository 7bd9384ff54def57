"""Whether outputs respond to their inputs at all: the best of many simple responses against noise of its own colour.

The statistic is the largest share of the output that one response of a dictionary explains. What it is without an
response is seen on simulated noise, searched in the same way: the search over poles and delays is in the distribution.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array, BoolArray, IndexArray
from ctid_cli.filtering.simulate import simulate
from ctid_cli.inference.noise_model import fit_noise_model
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record
from ctid_cli.signals.treatment import InitialState

#: Probability that noise is taken for an answer.
LEVEL = 0.05
#: Simulated series of noise, and their seed: one record always gets one answer.
SERIES, SEED = 199, 20140801
#: The dictionary beside an integrator: time constants of first order, frequencies and dampings of second order.
TIME_CONSTANTS, FREQUENCIES, DAMPINGS = 10, 8, (0.05, 0.3, 0.9)
#: Least and greatest number of delays of each response; between them, one for each time constant of the response.
FEWEST_DELAYS, MOST_DELAYS = 12, 48
#: Of longer records means over successive samples are tested, at most this number of them.
MOST_SAMPLES = 2000
#: Shares of the false alarms that are given to the tests of the signals as they are, of what is new in them, and of
#: the likelihood. The second alone sees anything after fast inputs in slow noise, and the third after few steps, where
#: the output itself looks like slow noise and what the response leaves of it does not.
WEIGHTS = (0.4, 0.2, 0.4)
#: Most lags of the autoregression in the likelihood.
MOST_LAGS = 8
#: Length of periodic noise over that of the record it stands for.
PERIOD = 4
#: Outliers are cut off at this multiple of the deviation from the median that nine samples in ten do not exceed.
CUT_OFF = 5.0
#: Fewer samples than this tell nothing.
FEWEST_SAMPLES = 8
#: A response of which less than this share of the power is left beside offset and free response shows nothing.
NOTHING_LEFT = 1e-8
#: Power of the rounding of a signal, as a share of its own.
ROUNDING = 1e-12


@dataclass(frozen=True)
class AnswerTest:
    """The test of any response to the input against none."""

    #: Greatest share of the outputs' power about their means that one response explains [-].
    explained: float
    #: The share that noise of the outputs' colour exceeds in one record of fifty [-].
    by_chance: float
    #: Probability that such noise is explained as well as the outputs [-]; nan where it cannot be tested, because there
    #: are fewer than eight samples, or no response can be told from an offset and a free response.
    p_value: float

    @property
    def seen(self) -> bool:
        """Whether a response is seen; what cannot be tested is not denied."""
        return not self.p_value > LEVEL

    @property
    def evidence(self) -> str:
        """What was found, and what noise alone reaches."""
        return (
            f"One simple response explains at most {100 * self.explained:.2g} % of the output's variance; noise of the "
            f"output's colour reaches {100 * self.by_chance:.2g} % in one record of fifty."
        )


def response_test(
    records: Sequence[Record],
    used: Sequence[BoolArray],
    delays: tuple[float, float],
    initial_state: InitialState = "rest",
) -> AnswerTest:
    """Test the response of the outputs to the inputs, at the used samples of records of one system.

    Each record has an offset of its own, and a free response where it is estimated. The largest share is looked for
    in the signals as they are, and in the signals behind the filter that makes the output white; a third test asks how
    much likelier the output is with the response of the largest share. The smallest of the p-values, weighted, is
    compared with that of each series of noise. Samples count in their order: on an irregular clock the noise is taken
    as stationary in it.
    """
    rng, periodic, free = np.random.default_rng(SEED), initial_state == "periodic", initial_state == "estimate"
    outputs = [_Output.of(record, use, periodic, rng) for record, use in zip(records, used, strict=True)]
    longest = max((output.t[:, 0] for output in outputs), key=len)
    shares, testable = np.zeros((2, SERIES + 1)), False
    poles = _poles(float(np.median(np.diff(longest))), float(np.ptp(longest))) if longest.size >= FEWEST_SAMPLES else ()
    for pole in poles:
        count = int(np.clip(abs(pole) * np.ptp(delays) + 1, FEWEST_DELAYS, MOST_DELAYS))
        grid = np.unique(np.linspace(*delays, count))
        as_they_are, new = zip(*(output.beside_own(pole, grid, free) for output in outputs), strict=True)
        series, best, slopes, useful = _better(as_they_are, shares[0])
        for output, part in zip(outputs, as_they_are, strict=True):
            output.residual[:, series] = part.without_own(part.series[:, series]) - part.responses[:, best] * slopes
        testable |= useful | _better(new, shares[1])[-1]
    if not testable:
        return AnswerTest(float("nan"), float("nan"), float("nan"))
    statistics = zip((*shares, sum(output.likelihood_gain for output in outputs)), WEIGHTS, strict=True)
    # The tests have one level: the smallest of their weighted p-values is compared with that of each series.
    smallest = np.min([_p_values(statistic) / weight for statistic, weight in statistics], axis=0)
    by_chance = float(np.quantile(shares[0, 1:], 1.0 - LEVEL * WEIGHTS[0]))
    return AnswerTest(float(shares[0, 0]), by_chance, float(np.mean(smallest <= smallest[0])))


def _better(parts: Sequence["_BesideOwn"], shares: Array) -> tuple[IndexArray, IndexArray, Array, bool]:
    """Compare the responses of one pole in all records together; shares that they raise are raised in place.

    Returns the series of which a response explains more than any before, which response that is, its slope, and whether
    any response can be told from offset and free response.
    """
    products = sum(part.responses.T @ part.series for part in parts)
    power = sum(np.sum(part.responses**2, axis=0) for part in parts)
    useful = power > NOTHING_LEFT * sum(part.whole for part in parts)
    slopes = np.divide(products, power[:, None], out=np.zeros_like(products), where=useful[:, None])
    best = np.argmax(slopes * products, axis=0)
    fitted, total = np.max(slopes * products, axis=0), sum(part.total for part in parts)
    share = np.divide(fitted, total, out=np.zeros_like(total), where=total > 0.0)
    better = np.flatnonzero(share > shares)
    shares[better] = share[better]
    return better, best[better], slopes[best[better], better], bool(useful.any())


class _BesideOwn(NamedTuple):
    """Responses and series of a record, and what its own offset and free response explain of them."""

    #: Without what these explain, shape (n, d), and their power with it.
    responses: Array
    whole: Array
    #: With what these explain, shape (n, 1 + SERIES).
    series: Array
    #: Orthonormal columns that span offset and free response.
    own: Array

    @property
    def total(self) -> Array:
        """Power of the series without what is the record's own."""
        whole: Array = np.einsum("ij,ij->j", self.series, self.series)
        along: Array = np.sum((self.own.T @ self.series) ** 2, axis=0)
        return whole - along

    def without_own(self, columns: Array) -> Array:
        """Columns without offset and free response."""
        return columns - self.own @ (self.own.T @ columns)


@dataclass(frozen=True, eq=False)
class _Output:
    """The output of one record beside series of noise of its colour, and the input that they are tested against."""

    signal: HeldSignal
    #: Instants of the clock, shape (N,).
    clock: Array
    #: Instants of the used samples, those that are averaged in a row, shape (n, width).
    t: Array
    #: Prediction-error filter of the output.
    noise: Array
    #: The output first, about its mean, then the noise, shape (n, 1 + SERIES); and what is new in each sample of them.
    series: Array
    #: What the best response of all has left of them.
    residual: Array
    new: Array

    @classmethod
    def of(cls, record: Record, use: BoolArray, periodic: bool, rng: np.random.Generator) -> "_Output":
        """Lay a record out, and draw the noise."""
        signal, clock = record.input, record.t
        if periodic:
            # One period before the record settles all but the slowest responses.
            period = record.duration + float(np.median(np.diff(clock)))
            within = signal.t < signal.t[0] + period * (1.0 - 1e-9)
            once, values = signal.t[within], signal.values[within]
            signal = HeldSignal(np.append(once - period, once), np.append(values, values), signal.hold)
            clock = np.append(clock - period, clock)
        count = int(np.count_nonzero(use))
        width = -(-count // MOST_SAMPLES)
        t, y = (x[use][: count // width * width].reshape(-1, width) for x in (record.t, record.y))
        y = y.mean(axis=1) - np.median(y)
        limit = CUT_OFF * float(np.quantile(np.abs(y), 0.9))
        y = np.clip(y, -limit, limit) if limit > 0.0 else y
        y = y - y.mean()
        noise = _unbiased(fit_noise_model([y]).coefficients, y.size)
        series = np.column_stack([y, _drawn(noise, y.size, rng)])
        series -= series.mean(axis=0)
        # Each record weighs as its noise would: by the reciprocal of its variance.
        deviations = series.std(axis=0)
        series /= np.where(deviations > 0.0, deviations, 1.0)
        return cls(signal, clock, t, noise, series, np.zeros_like(series), _filtered(series, noise))

    def beside_own(self, pole: complex, delays: Array, free_response: bool) -> Iterator[_BesideOwn]:
        """Responses of a pole at all delays beside the series: the signals as they are, then what is new in them."""
        denominator = np.real(np.poly([pole, pole.conjugate()] if pole.imag else [pole]))
        response = simulate(TransferFunction([1.0], denominator), self.signal, self.clock)
        responses = self._delayed(response, delays)
        own = [np.ones(len(responses))]
        if free_response and pole:
            free = np.exp(pole * (self.t.mean(axis=1) - self.t[0, 0]))
            own += [free.real, free.imag] if pole.imag else [free.real]
        columns = np.column_stack([*own, responses])
        for series, seen in ((self.series, columns), (self.new, _filtered(columns, self.noise))):
            basis, _ = np.linalg.qr(seen[:, : len(own)])
            raw = seen[:, len(own) :]
            yield _BesideOwn(raw - basis @ (basis.T @ raw), np.sum(raw**2, axis=0), series, basis)

    def _delayed(self, response: Array, delays: Array) -> Array:
        """A response, delayed, at the samples or as the means over successive ones, shape (n, d)."""
        if self.t.shape[1] == 1:
            return np.interp(self.t - delays, self.clock, response, left=0.0)
        # Differences of its running sum at the ends: over all samples of the clock between them, also missing ones.
        edges = np.append(self.clock, 2.0 * self.clock[-1] - self.clock[-2])
        places = np.searchsorted(self.clock, self.t[:, [0, -1]]) + np.array([0, 1])
        sums = np.append(0.0, np.cumsum(response))
        first, last = (np.interp(end[:, None] - delays, edges, sums, left=0.0) for end in edges[places].T)
        return np.asarray((last - first) / np.diff(places))

    @property
    def likelihood_gain(self) -> Array:
        """Twice the gain in log likelihood by the best response, of each series, with autoregressive noise."""
        order = min(self.noise.size - 1, MOST_LAGS, len(self.series) // 10)
        return len(self.series) * (_log_innovations(self.series, order) - _log_innovations(self.residual, order))


def _log_innovations(columns: Array, order: int) -> Array:
    """Logarithm of the power that autoregression by least squares leaves of each column, but for a constant.

    Least squares, as Yule and Walker's equations leave far too much of slow noise.
    """
    lagged = [columns[order - k : len(columns) - k] for k in range(order + 1)]
    lagged = [column - column.mean(axis=0) for column in lagged]
    gram = np.array([[np.sum(one * other, axis=0) for one in lagged] for other in lagged]).transpose(2, 0, 1)
    # Nothing is left of a column without noise.
    gram += np.eye(order + 1) * (ROUNDING * gram[:, :1, :1] + np.finfo(float).tiny)
    whole = np.linalg.slogdet(gram)[1]
    return np.asarray(whole - np.linalg.slogdet(gram[:, 1:, 1:])[1] if order else whole)


def _poles(interval: float, length: float) -> Iterator[complex]:
    yield 0.0
    for constant in np.geomspace(interval / 2.0, length / 4.0, TIME_CONSTANTS):
        yield complex(-1.0 / constant)
    for w in np.geomspace(4.0 * np.pi / length, 0.8 * np.pi / interval, FREQUENCIES):
        for zeta in DAMPINGS:
            yield w * complex(-zeta, np.sqrt(1.0 - zeta**2))


def _unbiased(noise: Array, count: int) -> Array:
    """The autoregression with its slowest root, or pair of them, where it is on average.

    About the mean of a record the correlation of slow noise comes out too small, by (1 + 4 root)/n in Yule and Walker's
    equations (Marriott and Pope, Biometrika 41, 390-402, 1954).
    """
    roots = np.roots(noise)
    size = np.abs(roots)
    slowest = float(size.max(initial=0.0))
    if slowest == 0.0:
        return noise
    farther = min(slowest + (1.0 + 4.0 * slowest) / count, max(slowest, 1.0 - 0.5 / count))
    return np.real(np.poly(np.where(size == slowest, farther / slowest, 1.0) * roots))


def _drawn(noise: Array, count: int, rng: np.random.Generator) -> Array:
    """Series of the noise, one a column, cut from periodic ones that are so long that the period does not show."""
    from scipy.fft import irfft, next_fast_len, rfft  # slow to import

    length = next_fast_len(PERIOD * count, real=True)
    innovations = rfft(rng.standard_normal((length, SERIES)), axis=0)
    drawn: Array = irfft(innovations / rfft(noise, length)[:, None], length, axis=0)[:count]
    return drawn


def _filtered(columns: Array, noise: Array) -> Array:
    """What is new in each sample, without the transient of the filter."""
    from scipy.fft import irfft, next_fast_len, rfft  # slow to import

    count = len(columns)
    length = next_fast_len(count, real=True)
    # What wraps around falls into the transient.
    product = rfft(columns, length, axis=0) * rfft(noise, length)[:, None]
    new: Array = irfft(product, length, axis=0)[noise.size - 1 : count]
    return new


def _p_values(statistic: Array) -> Array:
    """Share of all series, each itself included, whose statistic is as large."""
    ordered = np.sort(statistic)
    return 1.0 - np.searchsorted(ordered, statistic, side="left") / statistic.size
