"""Test for a response of outputs to inputs: the best of many simple responses, compared with simulated noise.

The statistic is the largest share of the output that one response of a dictionary explains. Its distribution under the
null hypothesis is from simulated noise with the spectrum of the output and the same search over poles and delays.
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

#: False-alarm probability.
LEVEL = 0.05
#: Number of simulated noise series, and their fixed seed, for reproducible results.
SERIES, SEED = 199, 20140801
#: Dictionary apart from an integrator: numbers of first-order time constants and second-order frequencies, dampings.
TIME_CONSTANTS, FREQUENCIES, DAMPINGS = 10, 8, (0.05, 0.3, 0.9)
#: Least and greatest number of delays of each response; between these limits, one delay per time constant.
FEWEST_DELAYS, MOST_DELAYS = 12, 48
#: Largest number of tested samples; longer records are averaged over successive samples.
MOST_SAMPLES = 2000
#: Shares of the false-alarm probability of the tests of the unfiltered signals, of the innovations, and of the
#: likelihood. Only the second detects responses to fast inputs in slow noise, and only the third those to few steps,
#: for which the output resembles slow noise but its residual does not.
WEIGHTS = (0.4, 0.2, 0.4)
#: Most lags of the autoregression in the likelihood.
MOST_LAGS = 8
#: Length of periodic noise over that of the record.
PERIOD = 4
#: Outliers are clipped at this multiple of the 90 % quantile of the absolute deviation from the median.
CUT_OFF = 5.0
#: Fewest samples for a test.
FEWEST_SAMPLES = 8
#: Responses whose projection off offset and free response has less than this share of their power are not tested.
NOTHING_LEFT = 1e-8
#: Relative power of rounding errors.
ROUNDING = 1e-12


@dataclass(frozen=True)
class ResponseTest:
    """Result of the test for a response to the input."""

    #: Largest share of the outputs' variance that one response explains [-].
    explained: float
    #: Share exceeded by noise of the outputs' colour in one record of fifty [-].
    by_chance: float
    #: p-value [-]; NaN if it cannot be tested, because there are fewer than eight samples, or no response can be
    #: distinguished from an offset and a free response.
    p_value: float

    @property
    def seen(self) -> bool:
        """Whether a response is detected or cannot be tested."""
        return not self.p_value > LEVEL

    @property
    def evidence(self) -> str:
        """Explained share and its level under the null hypothesis, in words."""
        return (
            f"One simple response explains at most {100 * self.explained:.2g} % of the output's variance; noise of the "
            f"output's colour reaches {100 * self.by_chance:.2g} % in one record of fifty."
        )


def response_test(
    records: Sequence[Record],
    used: Sequence[BoolArray],
    delays: tuple[float, float],
    initial_state: InitialState = "rest",
) -> ResponseTest:
    """Test for a response of the outputs to the inputs, at the used samples of records of one system.

    Each record has a separate offset, and a free response if the initial state is estimated. The largest explained
    share is computed for the unfiltered and for the prewhitened signals; a third test uses the increase of the
    likelihood by the response with the largest share. The smallest weighted p-value is compared with that of each noise
    series. Lags count samples, also on an irregular clock.
    """
    rng, periodic, free = np.random.default_rng(SEED), initial_state == "periodic", initial_state == "estimate"
    outputs = [_Output.of(record, use, periodic, rng) for record, use in zip(records, used, strict=True)]
    longest = max((output.t[:, 0] for output in outputs), key=len)
    shares, testable = np.zeros((2, SERIES + 1)), False
    poles = _poles(float(np.median(np.diff(longest))), float(np.ptp(longest))) if longest.size >= FEWEST_SAMPLES else ()
    for pole in poles:
        count = int(np.clip(abs(pole) * np.ptp(delays) + 1, FEWEST_DELAYS, MOST_DELAYS))
        grid = np.unique(np.linspace(*delays, count))
        unfiltered, whitened = zip(*(output.projected(pole, grid, free) for output in outputs), strict=True)
        series, best, slopes, useful = _better(unfiltered, shares[0])
        for output, part in zip(outputs, unfiltered, strict=True):
            output.residual[:, series] = part.project(part.series[:, series]) - part.responses[:, best] * slopes
        testable |= useful | _better(whitened, shares[1])[-1]
    if not testable:
        return ResponseTest(float("nan"), float("nan"), float("nan"))
    statistics = zip((*shares, sum(output.likelihood_gain for output in outputs)), WEIGHTS, strict=True)
    # One level for all tests: the smallest weighted p-value is compared with that of each series.
    smallest = np.min([_p_values(statistic) / weight for statistic, weight in statistics], axis=0)
    by_chance = float(np.quantile(shares[0, 1:], 1.0 - LEVEL * WEIGHTS[0]))
    return ResponseTest(float(shares[0, 0]), by_chance, float(np.mean(smallest <= smallest[0])))


def _better(parts: Sequence["_Projected"], shares: Array) -> tuple[IndexArray, IndexArray, Array, bool]:
    """Fit the responses of one pole to all records jointly, and update the largest shares in place.

    Returns the series with a larger share than before, the index and slope of its response, and whether any response
    can be distinguished from offset and free response.
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


class _Projected(NamedTuple):
    """Responses of a record projected off its offset and free response, and series."""

    #: Projected responses, shape (n, d), and their power before the projection.
    responses: Array
    whole: Array
    #: Series before the projection, shape (n, 1 + SERIES).
    series: Array
    #: Orthonormal basis of offset and free response.
    basis: Array

    @property
    def total(self) -> Array:
        """Power of the projected series."""
        whole: Array = np.einsum("ij,ij->j", self.series, self.series)
        along: Array = np.sum((self.basis.T @ self.series) ** 2, axis=0)
        return whole - along

    def project(self, columns: Array) -> Array:
        """Return columns projected off offset and free response."""
        return columns - self.basis @ (self.basis.T @ columns)


@dataclass(frozen=True, eq=False)
class _Output:
    """Output of one record and noise series of its colour, and the tested input."""

    signal: HeldSignal
    #: Instants of the clock, shape (N,).
    clock: Array
    #: Instants of the used samples, shape (n, width); the samples of a row are averaged.
    t: Array
    #: Prediction-error filter of the output.
    noise: Array
    #: The centred output, then the noise series, shape (n, 1 + SERIES).
    series: Array
    #: Residuals of the series after the best response.
    residual: Array
    #: Innovations of the series.
    innovations: Array

    @classmethod
    def of(cls, record: Record, use: BoolArray, periodic: bool, rng: np.random.Generator) -> "_Output":
        """Lay a record out, and draw the noise."""
        signal, clock = record.input, record.t
        if periodic:
            # One additional period before the record, after which all but the slowest responses have settled.
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
        # Records are weighted by the reciprocal variance of their noise.
        deviations = series.std(axis=0)
        series /= np.where(deviations > 0.0, deviations, 1.0)
        return cls(signal, clock, t, noise, series, np.zeros_like(series), _filtered(series, noise))

    def projected(self, pole: complex, delays: Array, free_response: bool) -> Iterator[_Projected]:
        """Yield the projected responses of a pole at all delays, for the unfiltered signals and for the innovations."""
        denominator = np.real(np.poly([pole, pole.conjugate()] if pole.imag else [pole]))
        response = simulate(TransferFunction([1.0], denominator), self.signal, self.clock)
        responses = self._delayed(response, delays)
        nuisance = [np.ones(len(responses))]
        if free_response and pole:
            free = np.exp(pole * (self.t.mean(axis=1) - self.t[0, 0]))
            nuisance += [free.real, free.imag] if pole.imag else [free.real]
        columns = np.column_stack([*nuisance, responses])
        for series, used in ((self.series, columns), (self.innovations, _filtered(columns, self.noise))):
            basis, _ = np.linalg.qr(used[:, : len(nuisance)])
            raw = used[:, len(nuisance) :]
            yield _Projected(raw - basis @ (basis.T @ raw), np.sum(raw**2, axis=0), series, basis)

    def _delayed(self, response: Array, delays: Array) -> Array:
        """Return a delayed response at the samples, or its means over successive ones, shape (n, d)."""
        if self.t.shape[1] == 1:
            return np.interp(self.t - delays, self.clock, response, left=0.0)
        # Differences of its cumulative sum, over all samples of the clock including missing ones.
        edges = np.append(self.clock, 2.0 * self.clock[-1] - self.clock[-2])
        places = np.searchsorted(self.clock, self.t[:, [0, -1]]) + np.array([0, 1])
        sums = np.append(0.0, np.cumsum(response))
        first, last = (np.interp(end[:, None] - delays, edges, sums, left=0.0) for end in edges[places].T)
        return np.asarray((last - first) / np.diff(places))

    @property
    def likelihood_gain(self) -> Array:
        """Twice the increase of the log-likelihood by the best response, of each series, with autoregressive noise."""
        order = min(self.noise.size - 1, MOST_LAGS, len(self.series) // 10)
        return len(self.series) * (_log_innovations(self.series, order) - _log_innovations(self.residual, order))


def _log_innovations(columns: Array, order: int) -> Array:
    """Return the logarithm of the residual power of a least-squares autoregression of each column, up to a constant.

    Least squares, because Yule and Walker's equations overestimate it for slow noise.
    """
    lagged = [columns[order - k : len(columns) - k] for k in range(order + 1)]
    lagged = [column - column.mean(axis=0) for column in lagged]
    gram = np.array([[np.sum(one * other, axis=0) for one in lagged] for other in lagged]).transpose(2, 0, 1)
    # Regularised for columns without noise.
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
    """Return the autoregression with the bias of its slowest root, or pair, corrected.

    About the mean of a record the correlation of slow noise is underestimated by (1 + 4 root)/n in Yule and Walker's
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
    """Return noise series as columns, cut from longer periodic ones."""
    from scipy.fft import irfft, next_fast_len, rfft  # slow to import

    length = next_fast_len(PERIOD * count, real=True)
    white = rfft(rng.standard_normal((length, SERIES)), axis=0)
    drawn: Array = irfft(white / rfft(noise, length)[:, None], length, axis=0)[:count]
    return drawn


def _filtered(columns: Array, noise: Array) -> Array:
    """Return the innovations of columns, without the transient of the filter."""
    from scipy.fft import irfft, next_fast_len, rfft  # slow to import

    count = len(columns)
    length = next_fast_len(count, real=True)
    # Circular wrap-around falls into the transient, which is dropped.
    product = rfft(columns, length, axis=0) * rfft(noise, length)[:, None]
    innovations: Array = irfft(product, length, axis=0)[noise.size - 1 : count]
    return innovations


def _p_values(statistic: Array) -> Array:
    """Return for each series the share of series, itself included, with a statistic at least as large."""
    ordered = np.sort(statistic)
    return 1.0 - np.searchsorted(ordered, statistic, side="left") / statistic.size
