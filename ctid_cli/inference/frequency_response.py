"""The frequency response that a record shows without any model, and how far it can be trusted."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np

from ctid_cli.arrays import Array, BoolArray, ComplexArray
from ctid_cli.errors import DataError
from ctid_cli.filtering.spectra import record_spectra
from ctid_cli.inference.input_response import analyse_response
from ctid_cli.inference.signal_features import input_moves
from ctid_cli.inference.spectral_methods import (
    ResponseLines,
    find_period,
    from_periods,
    images,
    local_polynomial,
    welch,
)
from ctid_cli.signals.checks import require_choice, require_integer
from ctid_cli.signals.frequency_data import FrequencyData, held_data
from ctid_cli.signals.held import REGULARITY, Hold, hold_factor
from ctid_cli.signals.record import Record, named
from ctid_cli.signals.treatment import ResponseMethod

#: How a response was estimated.
Estimate = Literal["periodic", "local-polynomial", "welch"]
#: Up to this share of missing outputs is bridged by straight lines.
MOST_MISSING = 0.05
#: A change of the input belongs to a sample that is no further away than this fraction of the interval.
ON_GRID = 1e-5
#: The images of a hold are worth a word where they may exceed this share of the response.
IMAGES_MATTER = 0.05
#: Places at which a response is estimated, unless another number is asked for.
POINTS = 400
#: Frequencies on each side of one whose phases must mostly be known for its own, and unknown ones that a phase is
#: followed across.
BESIDE, BRIDGED = 2, 2
#: Fewer frequencies than these are no response over frequency.
FEWEST = 3


@dataclass(frozen=True, eq=False)
class FrequencyResponse:
    """A frequency response estimated without a model.

    Parameters
    ----------
    frequencies : ndarray, shape (K,)
        Frequencies [rad/s], rising.
    response : ndarray, shape (K,)
        Complex response ``G(jw)`` [output unit/input unit], with what the hold does to the input taken out.
    variance : ndarray, shape (K,)
        Variance ``E |error|^2`` of the response by the noise [(output unit/input unit)^2]; of several realisations by
        noise and nonlinear distortions.
    freedom : ndarray, shape (K,)
        Degrees of freedom of the complex residuals that the variance is from [-].
    coherence : ndarray, shape (K,)
        Share of the output's power at that frequency that follows the input linearly [-].
    distortion : ndarray or None, shape (K,)
        Variance that nonlinear distortions give the response to one realisation of the input [(output unit/input
        unit)^2]; None where the record does not tell.
    bias : ndarray, shape (K,)
        Bound of what the images of a sampled input add [output unit/input unit], for a gain that falls like 1/w or
        faster beyond the highest frequencies.
    method : {"periodic", "local-polynomial", "welch"}
        How it was estimated.
    hold : {"zoh", "foh", "band-limited"}
        What the input was taken to do between its samples.
    notes : tuple of str
        What was chosen, and what to know before believing the numbers; where there is no interval, why.
    told : ndarray of bool, shape (K,)
        Whether an interval is given.
    interval : float, default 0.0
        Sampling interval of the values of samples that the response of a zero-order hold was divided out of [s]; 0
        where none was.
    """

    frequencies: Array
    response: ComplexArray
    variance: Array
    freedom: Array
    coherence: Array
    distortion: Array | None
    bias: Array
    method: Estimate
    hold: Hold
    notes: tuple[str, ...]
    told: BoolArray
    interval: float = 0.0

    def __repr__(self) -> str:
        low, high = self.frequencies[[0, -1]]
        return f"FrequencyResponse({self.frequencies.size} frequencies from {low:g} to {high:g} rad/s, {self.method})"

    @property
    def data(self) -> FrequencyData:
        """The response as data for a model: of a clock with a zero-order hold the values of samples."""
        values = self.frequencies, self.response, self.standard_error
        others: Any = {"correlated": self.method != "periodic", "freedom": float(np.median(self.freedom))}
        if self.interval:
            return held_data(*values, self.interval, **others)
        return FrequencyData(*values, **others)

    @property
    def standard_error(self) -> Array:
        """Square root of the variance [output unit/input unit]."""
        return np.asarray(np.sqrt(self.variance))

    def radius(self, level: float = 0.95) -> Array:
        """Radius of the circles in the complex plane that hold the true values, each with that probability.

        Parameters
        ----------
        level : float, default 0.95
            Probability [-].

        Returns
        -------
        ndarray, shape (K,)
            Radii [output unit/input unit]: with d degrees of freedom ``|error|^2`` over its variance has the
            F-distribution of 2 and 2 d degrees of freedom. NaN where no interval is given.
        """
        return np.where(self.told, self._radius(level), np.nan)

    def gain_band(self, level: float = 0.95) -> tuple[Array, Array]:
        """Pointwise interval of the gain; its lower end is zero where the response may be.

        Parameters
        ----------
        level : float, default 0.95
            Probability [-].

        Returns
        -------
        low, high : ndarray, shape (K,)
            Ends [output unit/input unit]; NaN where no interval is given.
        """
        gain, half = np.abs(self.response), np.where(self.told, self._half_width(level), np.nan)
        low = np.where(gain > self._radius(level), gain - half, 0.0)
        return np.where(self.told, low, np.nan), gain + half

    def phase_known(self, level: float = 0.95) -> BoolArray:
        """Whether the phase is known to better than a quarter of a turn to each side.

        Parameters
        ----------
        level : float, default 0.95
            Probability [-].

        Returns
        -------
        ndarray of bool, shape (K,)
            True where an interval is given, the circle of that probability around the response leaves out zero, and
            the same holds for most of the five frequencies around: of many frequencies with noise alone some leave out
            zero by chance.
        """
        clear = self.told & (np.abs(self.response) > self._radius(level))
        around = np.ones(2 * BESIDE + 1)
        share = np.convolve(clear, around, "same") / np.convolve(np.ones(clear.size), around, "same")
        return np.asarray(clear & (share > 0.5))

    def phase(self, level: float = 0.95) -> Array:
        """Phase, followed over the frequencies at which it is known.

        Parameters
        ----------
        level : float, default 0.95
            Probability of the intervals that decide where it is known [-].

        Returns
        -------
        ndarray, shape (K,)
            Phases [rad]; NaN where unknown. After more than two unknown frequencies, and where the turn to the next
            known one may be more than half a turn, it begins anew between -pi and pi.
        """
        phase = np.full(self.response.size, np.nan)
        places = np.flatnonzero(self.phase_known(level))
        angle, half = np.angle(self.response[places]), self.phase_band(level)[places]
        turn = np.angle(self.response[places][1:] * self.response[places][:-1].conj())
        followed = (np.diff(places) <= BRIDGED + 1) & (np.abs(turn) + np.hypot(half[1:], half[:-1]) < np.pi)
        for run in np.split(np.arange(places.size), np.flatnonzero(~followed) + 1):
            phase[places[run]] = np.unwrap(angle[run])
        return phase

    def phase_band(self, level: float = 0.95) -> Array:
        """Half the width of the pointwise interval of the phase.

        Parameters
        ----------
        level : float, default 0.95
            Probability [-].

        Returns
        -------
        ndarray, shape (K,)
            Half-widths [rad], below pi/2; NaN where the phase is not known.
        """
        share = self._half_width(level) / np.maximum(np.abs(self.response), 1e-300)
        return np.where(self.phase_known(level), np.arcsin(np.minimum(share, 1.0)), np.nan)

    def _radius(self, level: float) -> Array:
        """Radius of the circle around each estimate, whether or not it can be given."""
        return np.asarray(np.sqrt(self.variance * self.freedom * ((1.0 - level) ** (-1.0 / self.freedom) - 1.0)))

    def _half_width(self, level: float) -> Array:
        """Half the width of an interval of one part of the response."""
        from scipy.special import stdtrit

        return np.asarray(stdtrit(2 * self.freedom, 0.5 + level / 2) * np.sqrt(0.5 * self.variance))


def estimate_frequency_response(
    records: Record | Sequence[Record],
    *,
    method: ResponseMethod = "auto",
    period: int | None = None,
    half_width: int | None = None,
    segment: int | None = None,
    points: int = POINTS,
    time_unit: str = "s",
) -> FrequencyResponse:
    r"""Frequency response of what lies between input and output, without a model.

    Parameters
    ----------
    records : Record or sequence of Record
        A record; or several of one periodic experiment, each with another realisation of the input.
    method : {"auto", "periodic", "local-polynomial", "welch"}, default "auto"
        "periodic" from whole periods of a steady state, which "auto" takes where the input repeats itself;
        "local-polynomial" from any other record; "welch" by averages over segments, which "auto" takes where the input
        excites too few lines for the local polynomial.
    period : int, optional
        Period of the input [samples]; by default the first after which it repeats itself.
    half_width : int, optional
        Half-width of the local polynomial, 4 or more [lines of the record's own spectrum]; by default chosen for each
        frequency where the lines around it are best foretold by their neighbours.
    segment : int, optional
        Length of Welch's segments [samples]; by default an eighth of the record.
    points : int, default 400
        Frequencies at which a local polynomial estimates the response, at most [-].
    time_unit : str, default "s"
        Unit of time that the notes name.

    Returns
    -------
    FrequencyResponse
        Response, variance, coherence, level of nonlinear distortions.

    Raises
    ------
    DataError
        If the record is too short, its input excites nothing, or its clock is irregular and the method is not by local
        polynomials.
    ValueError
        If an option cannot be.

    Notes
    -----
    Spectra of samples add up the true spectra of all frequencies that look alike. What a hold does to the frequency
    itself is taken out; its images stay, ``sum_m G(j(w + m w_s)) H(w + m w_s)/H(w)`` with m ≠ 0, and are bounded in
    ``bias``. Without a hold (band-limited signals) there are none.

    The estimate by local polynomials has a variance from their residuals, which also hold what the polynomials cannot
    follow; no interval is given on peaks that are narrower than its lines. Neighbouring estimates share lines. Welch's
    method gives no intervals: leakage and flattened peaks are not in the scatter of its segments. On an irregular
    clock, with an input that moves between the samples, or with many samples missing, local polynomials take the exact
    spectrum of the held input and that of straight lines through the output; what these miss is noise-like and in the
    variance.

    References
    ----------
    R. Pintelon and J. Schoukens, *System Identification: A Frequency Domain Approach*, 2nd ed., Wiley, 2012,
    doi:10.1002/9781118287422.

    Examples
    --------
    >>> import numpy as np
    >>> from ctid_cli import Record, TransferFunction, simulate
    >>> t = 0.1 * np.arange(4000)
    >>> u = np.random.default_rng(0).standard_normal(t.size)
    >>> record = Record.from_arrays(t, u, np.zeros(t.size))
    >>> y = simulate(TransferFunction([2.0], [1.0, 1.0]), record.input, t)
    >>> found = estimate_frequency_response(Record(t, y, record.input))
    >>> float(abs(np.interp(1.0, found.frequencies, abs(found.response)) - 2 / np.sqrt(2)).round(2))
    0.0
    """
    require_choice("method", method, get_args(ResponseMethod))
    for name, value, least in (("period", period, 2), ("half_width", half_width, 4), ("points", points, FEWEST)):
        if value is not None:
            require_integer(name, value, least)
    every = [records] if isinstance(records, Record) else list(records)
    if not every:
        raise DataError("there is no record to estimate a frequency response from")
    for record in every:
        if input_moves(record).kind == "constant":
            raise DataError(f"{named(record)}the input is constant: it excites no frequency")
    first = every[0]
    odd = next((sentence for record in every if (sentence := _not_on_one_clock(record))), None)
    if odd is not None:
        return _on_any_clock(every, odd, method, points, half_width, time_unit)
    signals = [(record.input.at(record.t), record.bridged_y) for record in every]
    interval = float(first.interval or 0.0)
    if method in ("auto", "periodic"):
        period = period or _common_period([u for u, _ in signals])
    if method == "periodic" and period is None:
        raise DataError("the input does not repeat itself; give its period in samples, or take another method")
    if len(every) > 1:
        _require_alike(every, period)
    if period is not None and method in ("auto", "periodic"):
        return _finished(from_periods(signals, period, interval), "periodic", first, time_unit)
    # A long delay turns the phase fast: the output is advanced to where it begins to respond.
    u, y = signals[0]
    shift = min(int(_begins(first) / interval), u.size // 2)
    u, y = u[: u.size - shift], y[shift:]
    if method != "welch":
        inputs, outputs = (np.fft.rfft(x - x.mean())[1 : (x.size + 1) // 2] / x.size for x in (u, y))
        lines = local_polynomial(inputs, outputs, 2 * np.pi / (u.size * interval), points, half_width, time_unit)
        if lines.frequencies.size >= FEWEST or method == "local-polynomial":
            return _finished(_delayed(lines, shift * interval), "local-polynomial", first, time_unit)
    lines = welch(u, y, interval, segment, time_unit)
    return _finished(_delayed(lines, shift * interval), "welch", first, time_unit)


def _on_any_clock(
    records: list[Record], reason: str, method: ResponseMethod, points: int, half_width: int | None, time_unit: str
) -> FrequencyResponse:
    """The same from the exact spectrum of the held input and from straight lines between the samples of the output."""
    (record, *more) = records
    if method not in ("auto", "local-polynomial") or more:
        wanted = "several records are taken as realisations" if more else f"--method {method}"
        raise DataError(
            f"{named(record)}{wanted} on one regular clock, but {reason}; use --method local-polynomial, one record "
            "at a time"
        )
    late = min(_begins(record), 0.5 * record.duration)
    spectra = record_spectra(record, late, np.inf, late, keep_mean=False)
    base = 2 * np.pi / spectra.duration
    found = _delayed(local_polynomial(spectra.inputs(late), spectra.outputs, base, points, half_width, time_unit), late)
    note = (
        f"Since {reason}, the spectrum of the output is that of straight lines between its samples, corrected for what "
        f"they damp; towards {np.pi / float(np.median(np.diff(record.t))):.3g} rad/{time_unit} that is rough."
    )
    _require_some(found, record)
    # The spectrum of the input is that of all its movements: no image of a hold is left.
    return _response(found, "local-polynomial", record, np.zeros(found.frequencies.size), note)


def _begins(record: Record) -> float:
    """Time before which the output does not respond [s]."""
    hint = analyse_response(record).delay
    return hint.early if hint is not None else 0.0


def _delayed(lines: ResponseLines, delay: float) -> ResponseLines:
    return lines._replace(response=lines.response * np.exp(-1j * lines.frequencies * delay))


def _require_some(lines: ResponseLines, record: Record) -> None:
    if lines.frequencies.size < FEWEST:
        raise DataError(
            f"{named(record)}the input excites too few frequencies for a response over frequency; record an input that"
            " switches often, a multisine or a chirp"
        )


def _finished(lines: ResponseLines, method: Estimate, record: Record, time_unit: str) -> FrequencyResponse:
    """The response to the input as it was between its samples."""
    _require_some(lines, record)
    hold, interval = record.input.hold, float(record.interval or 0.0)
    factor = hold_factor(hold, lines.frequencies, interval)
    power = np.abs(factor) ** 2
    distortion = None if lines.distortion is None else lines.distortion / power
    held = lines._replace(response=lines.response / factor, variance=lines.variance / power, distortion=distortion)
    bias = images(hold, held.frequencies, held.response, held.variance, interval)
    note = _of_hold(hold, held.frequencies, bias, np.abs(held.response), time_unit)
    return replace(_response(held, method, record, bias, note), interval=interval if hold == "zoh" else 0.0)


def _response(lines: ResponseLines, method: Estimate, record: Record, bias: Array, note: str) -> FrequencyResponse:
    """The result, with sentences on missing samples and on where its phase is unknown, and why."""
    notes = (*lines.notes, note, *_of_record(record))
    found = FrequencyResponse(*lines[:6], bias, method, record.input.hold, notes, lines.told)
    unknown = int(np.count_nonzero(found.told & ~found.phase_known()))
    if not unknown:
        return found
    text = (
        f"No phase at {unknown} of the {found.response.size} frequencies, where the interval of the response holds "
        "zero, or that of most frequencies around does."
    )
    return replace(found, notes=(*found.notes, text))


def _of_hold(hold: Hold, frequencies: Array, bias: Array, gain: Array, time_unit: str) -> str:
    """What the hold means for the estimate."""
    if hold == "band-limited":
        return (
            "Input and output are taken to have no power above half the sampling frequency (--hold band-limited): then "
            "nothing between the samples biases the estimate."
        )
    shape = "constant" if hold == "zoh" else "straight lines"
    text = f"The input is taken as {shape} between its samples (--hold {hold}); what that does to it is divided out."
    # From where on nearly all frequencies are concerned: noise makes some gains small.
    large = bias > IMAGES_MATTER * gain
    onward = np.cumsum(large[::-1])[::-1] >= 0.8 * np.arange(large.size, 0, -1)
    if (large & onward).any():
        where = f"from {frequencies[np.argmax(large & onward)]:.3g} rad/{time_unit} on"
        text += f" Its images may bias the estimate by more than {100 * IMAGES_MATTER:g} % {where}."
    return text + " With another hold the phase differs by up to half a sampling interval of delay." * (hold == "zoh")


def _of_record(record: Record) -> list[str]:
    missing = int(np.count_nonzero(~record.valid))
    if not missing:
        return []
    return [f"{missing} missing output samples are bridged by straight lines."]


def _not_on_one_clock(record: Record) -> str | None:
    """Why samples of input and output do not tell all that was recorded."""
    signal = record.input
    if record.interval is None:
        return "the clock is irregular"
    if record.valid.mean() < 1.0 - MOST_MISSING:
        return f"{100 * (1 - record.valid.mean()):.3g} % of the output samples are missing"
    inside = signal.t[(signal.t > record.t[0]) & (signal.t <= record.t[-1])]
    places = (inside - record.t[0]) / record.interval
    moves = bool(np.abs(places - np.round(places)).max(initial=0.0) > ON_GRID)
    return "the input moves between the instants of the output" if moves else None


def _common_period(inputs: list[Array]) -> int | None:
    found = {find_period(u) for u in inputs}
    return found.pop() if len(found) == 1 else None


def _require_alike(records: list[Record], period: int | None) -> None:
    """Refuse records that are no realisations of one periodic experiment."""
    first = records[0]
    if period is None:
        raise DataError(
            f"{len(records)} records are taken as realisations of one periodic input, and they do not all repeat "
            "themselves after the same number of samples; give the period in samples, or one record at a time"
        )
    for record in records[1:]:
        same = abs((record.interval or 0.0) - (first.interval or 0.0)) <= REGULARITY * (first.interval or 0.0)
        if not same or record.input.hold != first.input.hold:
            raise DataError(f"{named(record)}its clock or hold is not that of {first.name or 'the first record'}")
