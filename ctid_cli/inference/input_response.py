"""Bandwidth and delay of the response to the input, estimated without a model."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.inference.intervals import robust_deviation
from ctid_cli.inference.signal_features import QUIET_SHARE, InputMoves, begins_quietly, input_moves, outliers
from ctid_cli.progress import reported
from ctid_cli.signals.record import Record

#: Share of the power of the response within its band.
SHARE = 0.95
#: Least widths of the bands of the spectra in bins of the whole record, and largest number of bands per octave. Narrow
#: bands resolve resonances, wide ones average over more noise; those that explain more of the output are used.
BINS = (8, 24)
BANDS_PER_OCTAVE = 6
#: Neighbouring bins under a Hann window are correlated: the effective number is n over this factor.
HANN_OVERLAP = 1.9
#: Significance levels of the coherence of a single band, and of each of two neighbouring bands.
SINGLE_LEVEL, PAIR_LEVEL = 1e-6, 1e-2
#: The gain is not computed if the input density is below this fraction of its maximum.
EXCITED = 1e-3
#: Number of time shifts at which input and output are compared.
ALIGNMENTS = 3
#: Longer pauses between output samples, in median intervals, are not interpolated.
LONGEST_INTERPOLATED = 3.0
#: Largest number of grid points.
LONGEST_GRID = 1 << 19
#: Bandwidth times time constant of a first-order system for 95 % of the power of its impulse response.
FIRST_ORDER = 12.7
#: A response is significant above this number of standard deviations, and above this fraction of its peak.
SIGNIFICANT, SIGNIFICANT_FRACTION = 5.0, 0.3
#: Number of standard deviations above which a response may already have begun.
POSSIBLE = 3.0
#: Delays are searched within one period of an input whose autocorrelation exceeds this.
PERIODIC = 0.3
#: Greatest delay that is tried, as a share of the record; with a later response it is this multiple of its latest
#: beginning plus this number of sampling intervals, at most this share of the time after the first change of the input.
LATEST, LATE, FURTHER, REMAINING = 0.1, 1.5, 3, 0.9
#: A response is seen where the output is this many deviations away from its level in a quiet beginning.
ONSET = 5.0


@dataclass(frozen=True)
class Grid:
    """Input and output on a regular grid, linearly detrended."""

    #: Spacing [s]: the median interval of the record.
    interval: float
    #: Input [input unit], shape (n,).
    u: Array
    #: Output [output unit], interpolated; zero in gaps, shape (n,).
    y: Array
    #: False in gaps, which are longer than three intervals without output samples, shape (n,).
    known: BoolArray


@dataclass(frozen=True)
class DelayHint:
    """Interval of the delay of the response to the input."""

    #: The response begins between these times after a change of the input [s]; at ``late`` it is significant.
    early: float
    late: float
    #: Greatest response over its standard deviation under the null hypothesis [-].
    strength: float


@dataclass(frozen=True)
class InputResponse:
    """Bandwidth, input band and delay of a record."""

    #: Frequency below which 95 % of the response lies [rad/s]; the Nyquist frequency if no response is detected.
    bandwidth: float
    #: Frequencies between which 95 % of the power of the input lies [rad/s].
    input_band: tuple[float, float] = (math.nan, math.nan)
    delay: DelayHint | None = None


def output_bandwidth(record: Record) -> float:
    """Return the frequency below which 95 % of the power of the response to the input lies.

    The power of the response is the power of the output times its squared coherence with the input, which excludes
    noise of any colour. The bandwidth is computed from this power and from this power over that of the input, and the
    larger one is returned, because a resonance that this input hardly excites still affects the cost of a fit as a
    function of the delay. For an input of three steps or fewer, the bandwidth is that of a first-order system with the
    rise time of the response.
    """
    moves = input_moves(record)
    if moves.kind == "constant" and record.input.values[0]:
        # A step at the first sample.
        moves = replace(moves, kind="steps", changes=record.t[:1])
    return analyse_response(record, moves).bandwidth


@reported("response to the input")
def analyse_response(record: Record, moves: InputMoves | None = None) -> InputResponse:
    """Return band and delay of the response of the output to the input."""
    moves = moves or input_moves(record)
    grid = regular_grid(record)
    nyquist = math.pi / grid.interval
    if moves.kind == "constant" or grid.u.size < 8:
        return InputResponse(nyquist)
    if not np.any(grid.y):
        return InputResponse(nyquist, _Spectra.of(grid, 0, min(BINS)).input_band)
    if moves.kind == "steps":
        return _after_a_step(record, moves, nyquist)
    alignments = _peaks(np.abs(_cross_correlation(grid.u, grid.y, grid.u.size // 2)[grid.u.size // 2 :]))
    spectra = [_Spectra.of(grid, shift, bins) for shift in alignments for bins in BINS]
    best = max(spectra, key=lambda s: s.explained)
    # Among time shifts with a clear response, the one with the highest bandwidth is the best aligned there.
    spectra = [s for s in spectra if s.explained > 0.5 * best.explained]
    bandwidth = max((b for s in spectra for b in s.bandwidths), default=math.nan)
    bandwidths = best.bandwidths
    if math.isnan(bandwidth):
        bandwidth, bandwidths = nyquist, (nyquist,)
    return InputResponse(min(bandwidth, nyquist), best.input_band, _delay(grid, bandwidths, moves))


def regular_grid(record: Record) -> Grid:
    """Return the record on a regular grid, without outliers.

    The output is interpolated linearly. Changes of the input between grid points are delayed, by half an interval on
    average.
    """
    t, y = record.t[record.valid], record.y[record.valid]
    # One outlier can dominate a sum of squares.
    gross = outliers(y)
    t, y = np.delete(t, gross), np.delete(y, gross)
    interval = float(np.median(np.diff(record.t))) if record.n_samples > 1 else 1.0
    n = int(min(max(math.floor(record.duration / interval + 1e-6) + 1, 2), LONGEST_GRID))
    times = record.t[0] + interval * np.arange(n)
    after = np.searchsorted(t, times)
    span = t[np.minimum(after, t.size - 1)] - t[np.maximum(after - 1, 0)]
    known = span <= LONGEST_INTERPOLATED * interval
    # Rounding must not move a grid point to just before the break that it coincides with.
    u = record.input.at(times + 1e-6 * interval)
    return Grid(interval, _detrended(u), np.where(known, _detrended(np.interp(times, t, y)), 0.0), known)


def _detrended(x: Array) -> Array:
    ramp = np.linspace(-1.0, 1.0, x.size)
    flat = x - x.mean()
    flat = flat - ramp * float(ramp @ flat / (ramp @ ramp))
    # A straight line leaves rounding errors only.
    return flat if float(np.abs(flat).max()) > 1e-12 * float(np.abs(x).max()) else np.zeros(x.size)


def greatest_delay(records: Sequence[Record]) -> float:
    """Return the greatest delay that is tried [s]: a share of the record, or beyond the beginning of the response."""
    interval = max(float(np.median(np.diff(record.t))) for record in records)
    hints = [analyse_response(each).delay for record in records for each in record.each_input]
    lates = [hint.late for hint in hints if hint is not None] + [_onset(record) for record in records]
    late = max(LATE * late + FURTHER * interval for late in lates)
    remaining = min(record.t[-1] - first_change(record) for record in records)
    return float(min(max(LATEST * min(record.duration for record in records), late), REMAINING * remaining))


def _onset(record: Record) -> float:
    """Return the time from the first change of an input to the first response after a quiet beginning; 0 without."""
    if not begins_quietly(record):
        return 0.0
    t, y = record.t[record.valid], record.y[record.valid]
    first = min(float(input_moves(each).changes.min(initial=np.inf)) for each in record.each_input)
    before = y[t < first]
    away = np.abs(y - before.mean()) > max(ONSET * float(before.std()), QUIET_SHARE * float(y.std()))
    # Two samples in a row: one may be an outlier.
    both = np.flatnonzero(away[:-1] & away[1:] & (t[:-1] >= first))
    return float(t[both[0]] - first) if both.size else 0.0


def first_change(record: Record) -> float:
    """Return the first instant at which an input changes within a record [s]."""
    moving = [signal.t[1:][np.diff(signal.values) != 0.0] for signal in record.held.values()]
    inside = [float(t[t > record.t[0]].min(initial=np.inf)) for t in moving]
    first = min(inside)
    return first if first < record.t[-1] else float(record.t[0])


# --- frequency domain: the band --------------------------------------------------------------------


@dataclass(frozen=True)
class _Spectra:
    """Power of input, output and response in frequency bands, at one time shift."""

    edges: Array
    input_power: Array
    output_power: Array
    response_power: Array

    @classmethod
    def of(cls, grid: Grid, shift: int, narrowest: int) -> _Spectra:
        """Return spectra of input, and of output ``shift`` samples later, in bands of ``narrowest`` bins or more.

        Without the shift, a delay comparable with the averaging time would reduce the coherence.
        """
        u, y = grid.u[: grid.u.size - shift], grid.y[shift:]
        n = u.size
        window = np.hanning(n + 1)[:-1]
        U = np.fft.rfft(window * (u - u.mean()))
        Y = np.fft.rfft(window * (y - y.mean()))
        bins = [1]
        while bins[-1] < U.size:
            bins.append(max(bins[-1] + narrowest, int(bins[-1] * 2 ** (1 / BANDS_PER_OCTAVE))))
        # The last band includes the remaining bins, which are too few for a separate band.
        bins = [*[k for k in bins if k <= U.size - narrowest or k == 1], U.size]
        edges = np.array(bins)
        first = edges[:-1]
        uu = np.add.reduceat(np.abs(U) ** 2, first)
        yy = np.add.reduceat(np.abs(Y) ** 2, first)
        yu = np.abs(np.add.reduceat(Y * np.conj(U), first)) ** 2
        independent = np.maximum(np.diff(edges) / HANN_OVERLAP, 1.5)
        coherence = np.minimum(yu / np.maximum(uu * yy, np.finfo(float).tiny), 1.0)
        p_value = (1.0 - coherence) ** (independent - 1.0)
        likely = np.concatenate(([False], p_value < PAIR_LEVEL, [False]))
        detected = (p_value < SINGLE_LEVEL) | (likely[1:-1] & (likely[:-2] | likely[2:]))
        unbiased = np.clip((coherence - 1 / independent) / (1 - 1 / independent), 0.0, 1.0)
        response_power = np.where(detected, unbiased * yy, 0.0)
        return cls(edges * 2 * math.pi / (n * grid.interval), uu, yy, response_power)

    @property
    def explained(self) -> float:
        total = float(self.output_power.sum())
        return float(self.response_power.sum()) / total if total > 0 else 0.0

    @property
    def bandwidths(self) -> tuple[float, ...]:
        """Bandwidths of the response, and of the response to an input with white spectrum."""
        if not self.response_power.any():
            return ()
        width = np.diff(self.edges)
        density = self.input_power / width
        excited = density > EXCITED * density.max()
        gain = np.where(excited, self.response_power / np.where(excited, density, 1.0), 0.0)
        return tuple(self._quantile(power, SHARE) for power in (self.response_power, gain) if power.any())

    @property
    def input_band(self) -> tuple[float, float]:
        tail = (1 - SHARE) / 2
        k = int(np.searchsorted(np.cumsum(self.input_power), tail * self.input_power.sum()))
        return float(self.edges[k]), self._quantile(self.input_power, 1 - tail)

    def _quantile(self, power: Array, share: float) -> float:
        total = np.cumsum(power)
        return float(self.edges[1 + int(np.searchsorted(total, share * total[-1]))])


# --- time domain: the delay ------------------------------------------------------------------------


def _cross_correlation(u: Array, y: Array, longest: int) -> Array:
    """Return the mean of y(t + lag) u(t) for lags from -longest to longest [samples]."""
    n = 1 << (2 * u.size - 1).bit_length()
    r = np.fft.irfft(np.fft.rfft(y, n) * np.conj(np.fft.rfft(u, n)), n) / u.size
    return np.concatenate((r[n - longest :], r[: longest + 1]))


def _peaks(r: Array) -> list[int]:
    """Return the indices of the highest local maxima."""
    ringed = np.concatenate(([-np.inf], r, [-np.inf]))
    top = np.flatnonzero((ringed[1:-1] >= ringed[:-2]) & (ringed[1:-1] > ringed[2:]))
    return [int(k) for k in top[np.argsort(-r[top])][:ALIGNMENTS]]


def _whitener(u: Array, order: int) -> Array:
    """Return the coefficients of the prediction-error filter of u."""
    from scipy.linalg import solve_toeplitz

    r = _cross_correlation(u, u, order)[order:]
    r[0] *= 1 + 1e-6
    return np.concatenate(([1.0], -np.asarray(solve_toeplitz(r[:-1], r[1:]), dtype=float)))


def _filtered(x: Array, coefficients: Array) -> Array:
    n = 1 << (x.size + coefficients.size - 1).bit_length()
    return np.asarray(np.fft.irfft(np.fft.rfft(x, n) * np.fft.rfft(coefficients, n), n)[: x.size], dtype=float)


def _delay(grid: Grid, bandwidths: tuple[float, ...], moves: InputMoves) -> DelayHint | None:
    """Return the delay; None if none is detected.

    The correlation of the prewhitened input with the equally filtered output estimates the impulse response. There is
    no response at negative lags, which therefore show the level under the null hypothesis.
    """
    n, h = grid.u.size, grid.interval
    # The whitening filter must span one hold, because a held value depends on those of one hold earlier.
    hold = 1 if math.isnan(moves.shortest_hold) else math.ceil(moves.shortest_hold / h)
    whitener = _whitener(grid.u, max(2, min(max(64, 3 * hold), n // 8, 2048)))
    u, y = _filtered(grid.u, whitener), _filtered(grid.y, whitener)
    if not grid.known.all():
        # The filter spreads the edge of a gap over its length; most of the effect is within a few samples.
        gaps = np.convolve(~grid.known, np.ones(8), mode="full")[:n] > 0
        y = np.where(gaps, 0.0, y)
    power = math.sqrt(float(np.mean(u**2) * np.mean(y**2)))
    if power == 0.0:
        return None
    autocorrelation = _cross_correlation(u, u, n // 2)[n // 2 :] / float(np.mean(u**2))
    repeated = np.flatnonzero(autocorrelation[4 * hold :] > PERIODIC)
    # The response to a periodic input is periodic: all lags within one period contain it, or its tail.
    period = 4 * hold + int(np.argmax(autocorrelation[4 * hold :])) if repeated.size else 0
    longest = min(n // 3, period - 1) if period else n // 3
    r = _cross_correlation(u, y, longest) / power
    reference = slice(longest, None) if period else slice(None, longest)
    slowest = math.pi / (4 * min(bandwidths) * h)
    smoothed = list(_smoothed_correlations(r, longest, slowest, reference, 4 if period else 1))
    if not smoothed:
        return None
    # The least smoothed correlation that is clearly significant, else the most significant one.
    strongest = max(smoothed, key=lambda each: each.strength)
    found = next((s for s in smoothed if s.strength > max(2 * SIGNIFICANT, 0.5 * strongest.strength)), strongest)
    return found.onset(4 * math.ceil(slowest), h) if found.strength >= SIGNIFICANT else None


def _smoothed_correlations(
    r: Array, longest: int, slowest: float, reference: slice, parts: int
) -> Iterator[_SmoothedCorrelation]:
    """Yield increasingly smoothed correlations, normalised by the least deviation of the parts of the reference."""
    for scale in (0.25, 0.5, 1.0, 2.0, 4.0):
        width = 2 * (int(scale * slowest) // 2) + 1
        if width > max(longest // 4, 1):
            return
        z = np.convolve(r, np.full(width, 1.0 / width), mode="same")
        quiet = min(robust_deviation(part) for part in np.array_split(z[reference], parts))
        if quiet > 0:
            yield _SmoothedCorrelation(z / quiet, longest, width)


@dataclass(frozen=True)
class _SmoothedCorrelation:
    """Correlation over all lags, averaged over ``width`` lags, in standard deviations under the null hypothesis."""

    z: Array
    longest: int
    width: int

    @property
    def after(self) -> Array:
        return np.abs(self.z[self.longest :])

    @property
    def strength(self) -> float:
        return float(self.after.max())

    def onset(self, pause: int, interval: float) -> DelayHint:
        """Return the onset of the response that contains the peak, without interruptions longer than ``pause`` lags."""
        peak = int(np.argmax(self.after))
        significant = _first_of_run(self.after > max(SIGNIFICANT, SIGNIFICANT_FRACTION * self.strength), peak, pause)
        begin = _first_of_run(self.after > POSSIBLE, significant, max(2, pause // 4))
        # A smooth response exceeds the noise late; the slower it is, the later.
        margin = max(self.width / 2 + 1, 0.5 * (peak - begin))
        late = (significant + self.width // 2 + 1) * interval
        return DelayHint(max(begin - margin, 0.0) * interval, late, self.strength)


def _first_of_run(above: BoolArray, k: int, pause: int) -> int:
    """Return the first index of the run that ends at ``k``, allowing interruptions of up to ``pause`` indices."""
    while True:
        earlier = np.flatnonzero(above[max(0, k - pause) : k])
        if not earlier.size:
            return k
        k = max(0, k - pause) + int(earlier[0])


def _after_a_step(record: Record, moves: InputMoves, nyquist: float) -> InputResponse:
    """Return the response to the first step of an input with few changes."""
    t, y = record.t[record.valid], record.y[record.valid]
    begin = float(moves.changes[0])
    end = float(moves.changes[1]) if moves.changes.size > 1 else float(t[-1])
    rest = y[t <= begin] if np.any(t <= begin) else y[:1]
    after = (t > begin) & (t <= end)
    t, moved = t[after] - begin, np.abs(y[after] - np.median(rest))
    if moved.size < 8:
        return InputResponse(nyquist)
    steps = np.abs(np.diff(y))
    noise = robust_deviation(steps) / math.sqrt(2)
    quantum = float(steps[steps > 0].min()) if np.any(steps > 0) else 0.0
    threshold = max(4 * noise, 1.5 * quantum, 1e-6 * float(moved.max()))
    # Three consecutive samples, because a single one may be an outlier.
    beyond = moved > threshold
    onset = np.flatnonzero(beyond[:-2] & beyond[1:-1] & beyond[2:])
    if not onset.size:
        return InputResponse(nyquist)
    first = int(onset[0])
    doubled = first + int(np.argmax(moved[first:] > 2 * threshold))
    # Extrapolated back by a parabola through the two, doubled as a margin, since the level at rest is uncertain.
    before = float(t[first - 1]) if first else 0.0
    early = max(0.0, float(before - 2 * (t[doubled] - t[first]) / (math.sqrt(2) - 1)))
    settled = float(np.median(moved[-max(3, moved.size // 20) :]))
    rise = float(t[int(np.argmax(moved > 0.632 * settled))] - t[first])
    bandwidth = min(FIRST_ORDER / rise, nyquist) if rise > 0 else nyquist
    return InputResponse(bandwidth, delay=DelayHint(early, float(t[first]), float(moved.max() / threshold)))
