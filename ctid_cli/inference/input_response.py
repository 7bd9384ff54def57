"""Bandwidth and delay of the response to the input, from a record without a model."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.inference.intervals import robust_deviation
from ctid_cli.inference.signal_features import InputMoves, input_moves, outliers
from ctid_cli.signals.record import Record

#: Share of the power of the response that its band holds.
SHARE = 0.95
#: Bands of the spectra are at least this many bins of the whole record wide, and at most this number per octave. Narrow
#: ones resolve resonances, wide ones average over more noise; those that show more of the response count.
BINS = (8, 24)
BANDS_PER_OCTAVE = 6
#: Neighbouring bins under a Hann window are not independent: n of them count as n over this number.
HANN_OVERLAP = 1.9
#: Chance of a coherence like this without any response, for a band that is sure by itself and for one of a pair.
SURE, LIKELY = 1e-6, 1e-2
#: Where the input has less than this fraction of its greatest density, the gain is no more than noise.
EXCITED = 1e-3
#: Input and output are compared at this many alignments in time.
ALIGNMENTS = 3
#: Longer pauses between output samples, in median intervals, are not interpolated.
HOLE = 3.0
#: Records are analysed on at most this many grid points.
LONGEST_GRID = 1 << 19
#: Bandwidth times time constant of a first-order system for 95 % of the power of its impulse response.
FIRST_ORDER = 12.7
#: The response begins to be certain at this many standard deviations, or this fraction of its peak.
CERTAIN, CERTAIN_FRACTION = 5.0, 0.3
#: Before that, a response may have begun where it is above this many standard deviations.
DOUBTFUL = 3.0
#: An input repeats itself where its correlation with its own past is above this.
REPEATS = 0.3


@dataclass(frozen=True)
class Grid:
    """Input and output on a regular grid, without their linear trends."""

    #: Spacing [s]: the median interval of the record.
    interval: float
    #: Input [input unit], shape (n,).
    u: Array
    #: Output [output unit], interpolated; zero in holes, shape (n,).
    y: Array
    #: False in holes: where no output was measured for more than three intervals, shape (n,).
    known: BoolArray


@dataclass(frozen=True)
class DelayHint:
    """When the output begins to respond to the input."""

    #: The response begins between these times after a change of the input [s]; at ``late`` it is certain.
    early: float
    late: float
    #: Greatest response over the standard deviation of what chance gives [-].
    strength: float


@dataclass(frozen=True)
class InputResponse:
    """What the output shows of the input."""

    #: Frequency below which 95 % of the response lies [rad/s]; the Nyquist frequency where no response is seen.
    bandwidth: float
    #: Frequencies between which 95 % of the power of the input lies [rad/s].
    input_band: tuple[float, float] = (math.nan, math.nan)
    delay: DelayHint | None = None
    #: Time after which the input repeats itself [s]; nan where it does not.
    period: float = math.nan


def output_bandwidth(record: Record) -> float:
    """Frequency below which 95 % of the response of the output to the input lies.

    The power of the response is the power of the output times its squared coherence with the input, which leaves out
    the noise, whatever its colour. Power is counted twice, as it is and divided by that of the input where there is
    any, and the larger of the two bandwidths is returned: a resonance that this input hardly excites bends the cost
    of a fit as a function of the delay all the same. After an input of three steps or fewer, the bandwidth is
    that of a first-order system as fast as the answer.
    """
    moves = input_moves(record)
    if moves.kind == "constant" and record.input.values[0]:
        # A step at the first sample.
        moves = replace(moves, kind="steps", changes=record.t[:1])
    return analyse_response(record, moves).bandwidth


def analyse_response(record: Record, moves: InputMoves | None = None) -> InputResponse:
    """Band and delay of the response of the output to the input."""
    moves = moves or input_moves(record)
    grid = regular_grid(record)
    nyquist = math.pi / grid.interval
    if moves.kind == "constant" or grid.u.size < 8 or not np.any(grid.y):
        return InputResponse(nyquist)
    if moves.kind == "steps":
        return _after_a_step(record, moves, nyquist)
    alignments = _peaks(np.abs(_cross_correlation(grid.u, grid.y, grid.u.size // 2)[grid.u.size // 2 :]))
    spectra = [_Spectra.of(grid, shift, bins) for shift in alignments for bins in BINS]
    best = max(spectra, key=lambda s: s.explained)
    # Of those that show the response at all, whatever alignment shows it at the highest frequency is right there.
    spectra = [s for s in spectra if s.explained > 0.5 * best.explained]
    bandwidth = max((b for s in spectra for b in s.bandwidths), default=math.nan)
    bandwidths = best.bandwidths
    if math.isnan(bandwidth):
        bandwidth, bandwidths = nyquist, (nyquist,)
    timing = _delay_and_period(grid, bandwidths, moves)
    return InputResponse(min(bandwidth, nyquist), best.input_band, *timing)


def regular_grid(record: Record) -> Grid:
    """Record on a regular grid.

    Outliers are left out. The output is joined by straight lines between its samples. An input that changes between
    the grid points changes late, by half an interval on average.
    """
    t, y = record.t[record.valid], record.y[record.valid]
    # One wild sample is worth hundreds of others in a sum of squares.
    wild = outliers(y)
    t, y = np.delete(t, wild), np.delete(y, wild)
    interval = float(np.median(np.diff(record.t))) if record.n_samples > 1 else 1.0
    n = int(min(max(math.floor(record.duration / interval + 1e-6) + 1, 2), LONGEST_GRID))
    times = record.t[0] + interval * np.arange(n)
    after = np.searchsorted(t, times)
    span = t[np.minimum(after, t.size - 1)] - t[np.maximum(after - 1, 0)]
    known = span <= HOLE * interval
    # Rounding must not take a grid point to just before the break that it coincides with.
    u = record.input.at(times + 1e-6 * interval)
    return Grid(interval, _detrended(u), np.where(known, _detrended(np.interp(times, t, y)), 0.0), known)


def _detrended(x: Array) -> Array:
    ramp = np.linspace(-1.0, 1.0, x.size)
    flat = x - x.mean()
    flat = flat - ramp * float(ramp @ flat / (ramp @ ramp))
    # Rounding is all that is left of a straight line.
    return flat if float(np.abs(flat).max()) > 1e-12 * float(np.abs(x).max()) else np.zeros(x.size)


# --- in frequency: the band ------------------------------------------------------------------------


@dataclass(frozen=True)
class _Spectra:
    """Shares of output power that follow the input, in bands of frequency; one alignment in time."""

    edges: Array
    input_power: Array
    output_power: Array
    answer: Array

    @classmethod
    def of(cls, grid: Grid, shift: int, narrowest: int) -> _Spectra:
        """Spectra of the input and of the output ``shift`` samples later, in bands of ``narrowest`` bins or more.

        Without the shift, a delay of a good part of the averaging time would hide the coherence.
        """
        u, y = grid.u[: grid.u.size - shift], grid.y[shift:]
        n = u.size
        window = np.hanning(n + 1)[:-1]
        U = np.fft.rfft(window * (u - u.mean()))
        Y = np.fft.rfft(window * (y - y.mean()))
        bins = [1]
        while bins[-1] < U.size:
            bins.append(max(bins[-1] + narrowest, int(bins[-1] * 2 ** (1 / BANDS_PER_OCTAVE))))
        # What is left at the end is too narrow to average over, so the last band takes it in.
        bins = [*[k for k in bins if k <= U.size - narrowest or k == 1], U.size]
        edges = np.array(bins)
        first = edges[:-1]
        uu = np.add.reduceat(np.abs(U) ** 2, first)
        yy = np.add.reduceat(np.abs(Y) ** 2, first)
        yu = np.abs(np.add.reduceat(Y * np.conj(U), first)) ** 2
        independent = np.maximum(np.diff(edges) / HANN_OVERLAP, 1.5)
        coherence = np.minimum(yu / np.maximum(uu * yy, np.finfo(float).tiny), 1.0)
        chance = (1.0 - coherence) ** (independent - 1.0)
        likely = np.concatenate(([False], chance < LIKELY, [False]))
        seen = (chance < SURE) | (likely[1:-1] & (likely[:-2] | likely[2:]))
        unbiased = np.clip((coherence - 1 / independent) / (1 - 1 / independent), 0.0, 1.0)
        answer = np.where(seen, unbiased * yy, 0.0)
        return cls(edges * 2 * math.pi / (n * grid.interval), uu, yy, answer)

    @property
    def explained(self) -> float:
        total = float(self.output_power.sum())
        return float(self.answer.sum()) / total if total > 0 else 0.0

    @property
    def bandwidths(self) -> tuple[float, ...]:
        """The band of the response as it is, and that of the response to an equally strong input everywhere."""
        if not self.answer.any():
            return ()
        width = np.diff(self.edges)
        density = self.input_power / width
        excited = density > EXCITED * density.max()
        gain = np.where(excited, self.answer / np.where(excited, density, 1.0), 0.0)
        return tuple(self._quantile(power, SHARE) for power in (self.answer, gain) if power.any())

    @property
    def input_band(self) -> tuple[float, float]:
        tail = (1 - SHARE) / 2
        k = int(np.searchsorted(np.cumsum(self.input_power), tail * self.input_power.sum()))
        return float(self.edges[k]), self._quantile(self.input_power, 1 - tail)

    def _quantile(self, power: Array, share: float) -> float:
        total = np.cumsum(power)
        return float(self.edges[1 + int(np.searchsorted(total, share * total[-1]))])


# --- in time: the delay ----------------------------------------------------------------------------


def _cross_correlation(u: Array, y: Array, longest: int) -> Array:
    """Mean of y(t + lag) u(t) for lags from -longest to longest [samples]."""
    n = 1 << (2 * u.size - 1).bit_length()
    r = np.fft.irfft(np.fft.rfft(y, n) * np.conj(np.fft.rfft(u, n)), n) / u.size
    return np.concatenate((r[n - longest :], r[: longest + 1]))


def _peaks(r: Array) -> list[int]:
    """Places of the highest local maxima."""
    ringed = np.concatenate(([-np.inf], r, [-np.inf]))
    top = np.flatnonzero((ringed[1:-1] >= ringed[:-2]) & (ringed[1:-1] > ringed[2:]))
    return [int(k) for k in top[np.argsort(-r[top])][:ALIGNMENTS]]


def _whitener(u: Array, order: int) -> Array:
    """Coefficients of the filter that predicts u from its past and leaves what is new."""
    from scipy.linalg import solve_toeplitz

    r = _cross_correlation(u, u, order)[order:]
    r[0] *= 1 + 1e-6
    return np.concatenate(([1.0], -np.asarray(solve_toeplitz(r[:-1], r[1:]), dtype=float)))


def _filtered(x: Array, coefficients: Array) -> Array:
    n = 1 << (x.size + coefficients.size - 1).bit_length()
    return np.asarray(np.fft.irfft(np.fft.rfft(x, n) * np.fft.rfft(coefficients, n), n)[: x.size], dtype=float)


def _delay_and_period(grid: Grid, bandwidths: tuple[float, ...], moves: InputMoves) -> tuple[DelayHint | None, float]:
    """Delay, and period of the input.

    The correlation of the whitened input with the equally filtered output is the impulse response in noise. The
    output does not respond before the input moves, so negative lags show what chance gives.
    """
    n, h = grid.u.size, grid.interval
    # Holding makes a value depend on those of one hold before, so that is how far the whitening has to look.
    hold = 1 if math.isnan(moves.shortest_hold) else math.ceil(moves.shortest_hold / h)
    whitener = _whitener(grid.u, max(2, min(max(64, 3 * hold), n // 8, 2048)))
    u, y = _filtered(grid.u, whitener), _filtered(grid.y, whitener)
    if not grid.known.all():
        # The filter smears the edge of a hole over its length; most of it lies within a few samples.
        holes = np.convolve(~grid.known, np.ones(8), mode="full")[:n] > 0
        y = np.where(holes, 0.0, y)
    power = math.sqrt(float(np.mean(u**2) * np.mean(y**2)))
    if power == 0.0:
        return None, math.nan
    own = _cross_correlation(u, u, n // 2)[n // 2 :] / float(np.mean(u**2))
    again = np.flatnonzero(own[4 * hold :] > REPEATS)
    # The response to a periodic input is periodic too: every lag within one period shows it, or its tail.
    period = 4 * hold + int(np.argmax(own[4 * hold :])) if again.size else 0
    longest = min(n // 3, period - 1) if period else n // 3
    r = _cross_correlation(u, y, longest) / power
    reference = slice(longest, None) if period else slice(None, longest)
    slowest = math.pi / (4 * min(bandwidths) * h)
    pictures = list(_pictures(r, longest, slowest, reference, 4 if period else 1))
    if not pictures:
        return None, period * h or math.nan
    # The sharpest picture that is clear enough, else the clearest.
    clearest = max(pictures, key=lambda picture: picture.strength)
    found = next((p for p in pictures if p.strength > max(2 * CERTAIN, 0.5 * clearest.strength)), clearest)
    hint = found.onset(4 * math.ceil(slowest), h) if found.strength >= CERTAIN else None
    return hint, period * h or math.nan


def _pictures(r: Array, longest: int, slowest: float, reference: slice, parts: int) -> Iterator[_Picture]:
    """The correlation smoothed ever more, each over what chance gives in the quietest part of the reference."""
    for scale in (0.25, 0.5, 1.0, 2.0, 4.0):
        width = 2 * (int(scale * slowest) // 2) + 1
        if width > max(longest // 4, 1):
            return
        z = np.convolve(r, np.full(width, 1.0 / width), mode="same")
        quiet = min(robust_deviation(part) for part in np.array_split(z[reference], parts))
        if quiet > 0:
            yield _Picture(z / quiet, longest, width)


@dataclass(frozen=True)
class _Picture:
    """Correlation over all lags, in standard deviations of chance; a mean over ``width`` lags."""

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
        """Where the response that holds the peak begins, which no pause of ``pause`` lags interrupts."""
        peak = int(np.argmax(self.after))
        sure = _first_of_run(self.after > max(CERTAIN, CERTAIN_FRACTION * self.strength), peak, pause)
        begin = _first_of_run(self.after > DOUBTFUL, sure, max(2, pause // 4))
        # A smooth response rises out of the noise late, the later the slower it is.
        margin = max(self.width / 2 + 1, 0.5 * (peak - begin))
        late = (sure + self.width // 2 + 1) * interval
        return DelayHint(max(begin - margin, 0.0) * interval, late, self.strength)


def _first_of_run(above: BoolArray, k: int, pause: int) -> int:
    """First place of the run that place ``k`` ends, where up to ``pause`` places below do not end it."""
    while True:
        earlier = np.flatnonzero(above[max(0, k - pause) : k])
        if not earlier.size:
            return k
        k = max(0, k - pause) + int(earlier[0])


def _after_a_step(record: Record, moves: InputMoves, nyquist: float) -> InputResponse:
    """InputResponse to the first step of an input that moves seldom."""
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
    # Three in a row: a single one is an outlier.
    beyond = moved > threshold
    onset = np.flatnonzero(beyond[:-2] & beyond[1:-1] & beyond[2:])
    if not onset.size:
        return InputResponse(nyquist)
    first = int(onset[0])
    doubled = first + int(np.argmax(moved[first:] > 2 * threshold))
    # Traced back along a parabola through the two, twice as far: the level at rest is not known exactly.
    before = float(t[first - 1]) if first else 0.0
    early = max(0.0, float(before - 2 * (t[doubled] - t[first]) / (math.sqrt(2) - 1)))
    settled = float(np.median(moved[-max(3, moved.size // 20) :]))
    rise = float(t[int(np.argmax(moved > 0.632 * settled))] - t[first])
    bandwidth = min(FIRST_ORDER / rise, nyquist) if rise > 0 else nyquist
    return InputResponse(bandwidth, delay=DelayHint(early, float(t[first]), float(moved.max() / threshold)))
