"""Nonparametric frequency response of a record, with its uncertainty."""

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
from ctid_cli.processors import one_thread
from ctid_cli.progress import reported
from ctid_cli.signals.checks import require_choice, require_integer
from ctid_cli.signals.frequency_data import FrequencyData, held_data
from ctid_cli.signals.held import REGULARITY, Hold, hold_factor
from ctid_cli.signals.record import Record, as_records, named
from ctid_cli.signals.treatment import ResponseMethod

#: Method of estimation.
Estimate = Literal["periodic", "local-polynomial", "welch"]
#: Largest share of missing outputs that are interpolated linearly.
MOST_MISSING = 0.05
#: Tolerance within which a change of the input counts as at a sample [sampling intervals].
ON_GRID = 1e-5
#: Images of a hold are reported if they may exceed this share of the response.
IMAGES_MATTER = 0.05
#: Default number of frequencies.
POINTS = 400
#: Neighbours on each side most of which must have a known phase, and largest gap across which a phase is unwrapped.
NEIGHBOURS, BRIDGED = 2, 2
#: Fewest frequencies of a response.
FEWEST = 3


@dataclass(frozen=True, eq=False)
class FrequencyResponse:
    """A frequency response estimated without a model.

    Parameters
    ----------
    frequencies : ndarray, shape (K,)
        Frequencies [rad/s], rising.
    response : ndarray, shape (K,)
        Complex response ``G(jw)`` [output unit/input unit], corrected for the hold of the input.
    variance : ndarray, shape (K,)
        Variance ``E |error|^2`` of the response due to the noise [(output unit/input unit)^2]; for several realisations
        due to noise and nonlinear distortions.
    freedom : ndarray, shape (K,)
        Degrees of freedom of the complex residuals of the variance [-].
    coherence : ndarray, shape (K,)
        Share of the output's power at that frequency that is linear in the input [-].
    distortion : ndarray or None, shape (K,)
        Variance of the response to one realisation of the input due to nonlinear distortions [(output unit/input
        unit)^2]; None if the record does not determine it.
    bias : ndarray, shape (K,)
        Bound of the images of a sampled input [output unit/input unit], for a gain that falls like 1/w or faster beyond
        the highest frequencies.
    method : {"periodic", "local-polynomial", "welch"}
        Method of estimation.
    hold : {"zoh", "foh", "band-limited"}
        Assumed intersample behaviour of the input.
    notes : tuple of str
        Choices, limitations, and reasons for missing intervals.
    has_interval : ndarray of bool, shape (K,)
        Whether an interval is given.
    interval : float, default 0.0
        Sampling interval [s] if the response was corrected for a zero-order hold; else 0.
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
    has_interval: BoolArray
    interval: float = 0.0

    def __repr__(self) -> str:
        low, high = self.frequencies[[0, -1]]
        return f"FrequencyResponse({self.frequencies.size} frequencies from {low:g} to {high:g} rad/s, {self.method})"

    @property
    def data(self) -> FrequencyData:
        """The response as data for a model; with a zero-order hold as the sampled response."""
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
        """Return the radius of the confidence circles in the complex plane, pointwise.

        Parameters
        ----------
        level : float, default 0.95
            Probability [-].

        Returns
        -------
        ndarray, shape (K,)
            Radii [output unit/input unit]: with d degrees of freedom ``|error|^2`` over its variance has the
            F-distribution of 2 and 2 d degrees of freedom. NaN if no interval is given.
        """
        return np.where(self.has_interval, self._radius(level), np.nan)

    def gain_band(self, level: float = 0.95) -> tuple[Array, Array]:
        """Return the pointwise interval of the gain; its lower end is zero if the circle contains zero.

        Parameters
        ----------
        level : float, default 0.95
            Probability [-].

        Returns
        -------
        low, high : ndarray, shape (K,)
            Ends [output unit/input unit]; NaN if no interval is given.
        """
        gain, half = np.abs(self.response), np.where(self.has_interval, self._half_width(level), np.nan)
        low = np.where(gain > self._radius(level), gain - half, 0.0)
        return np.where(self.has_interval, low, np.nan), gain + half

    def phase_known(self, level: float = 0.95) -> BoolArray:
        """Return whether the phase is known to better than 90 degrees to each side.

        Parameters
        ----------
        level : float, default 0.95
            Probability [-].

        Returns
        -------
        ndarray of bool, shape (K,)
            True if an interval is given and the confidence circle excludes zero, at this frequency and at most of the
            five frequencies around it: with noise only, some circles of many exclude zero.
        """
        clear = self.has_interval & (np.abs(self.response) > self._radius(level))
        around = np.ones(2 * NEIGHBOURS + 1)
        share = np.convolve(clear, around, "same") / np.convolve(np.ones(clear.size), around, "same")
        return np.asarray(clear & (share > 0.5))

    def phase(self, level: float = 0.95) -> Array:
        """Return the phase, unwrapped over the frequencies at which it is known.

        Parameters
        ----------
        level : float, default 0.95
            Confidence level for a known phase [-].

        Returns
        -------
        ndarray, shape (K,)
            Phases [rad]; NaN if unknown. After more than two unknown frequencies, and if the change to the next known
            one may exceed pi, the phase restarts between -pi and pi.
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
        """Return the half-width of the pointwise interval of the phase.

        Parameters
        ----------
        level : float, default 0.95
            Probability [-].

        Returns
        -------
        ndarray, shape (K,)
            Half-widths [rad], below pi/2; NaN if the phase is unknown.
        """
        share = self._half_width(level) / np.maximum(np.abs(self.response), 1e-300)
        return np.where(self.phase_known(level), np.arcsin(np.minimum(share, 1.0)), np.nan)

    def _radius(self, level: float) -> Array:
        """Return the radius of the circle around each estimate, also without an interval."""
        return np.asarray(np.sqrt(self.variance * self.freedom * ((1.0 - level) ** (-1.0 / self.freedom) - 1.0)))

    def _half_width(self, level: float) -> Array:
        """Return the half-width of the interval of one component of the response."""
        from scipy.special import stdtrit

        return np.asarray(stdtrit(2 * self.freedom, 0.5 + level / 2) * np.sqrt(0.5 * self.variance))


@one_thread
@reported("frequency response")
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
    r"""Estimate the frequency response from input to output without a parametric model.

    Parameters
    ----------
    records : Record or sequence of Record
        A record; or several of one periodic experiment with different realisations of the input.
    method : {"auto", "periodic", "local-polynomial", "welch"}, default "auto"
        "periodic" from whole periods of a steady state, which "auto" uses for a periodic input; "local-polynomial" from
        any other record; "welch" by averages over segments, which "auto" uses if the input excites too few lines for
        the local polynomial.
    period : int, optional
        Period of the input [samples]; by default the first repetition.
    half_width : int, optional
        Half-width of the local polynomial, 4 or more [lines of the record's spectrum]; by default chosen for each
        frequency from the residuals.
    segment : int, optional
        Length of Welch's segments [samples]; by default an eighth of the record.
    points : int, default 400
        Largest number of frequencies of a local polynomial estimate [-].
    time_unit : str, default "s"
        Unit of time in the notes.

    Returns
    -------
    FrequencyResponse
        Response, variance, coherence and level of nonlinear distortions.

    Raises
    ------
    DataError
        If the record is too short, its input is not exciting, or its clock is irregular and the method is not
        "local-polynomial".
    ValueError
        If an option is invalid.

    Notes
    -----
    Spectra of samples are sums of the true spectra over all aliased frequencies. The response is corrected for the
    hold; the images ``sum_m G(j(w + m w_s)) H(w + m w_s)/H(w)``, m ≠ 0, remain and are bounded in ``bias``. Without a
    hold (band-limited signals) there are none.

    The variance of local polynomials is from their residuals, which include the approximation error of the polynomials;
    no interval is given on peaks that are narrower than the window. Neighbouring estimates share lines. Welch's method
    gives no intervals: leakage and flattened peaks do not show in the scatter of its segments. On an irregular clock,
    with an input that changes between the samples, or with many samples missing, local polynomials use the exact
    spectrum of the held input and that of the linearly interpolated output; the interpolation error is noise-like and
    included in the variance.

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
    every = as_records(records)
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
        raise DataError("the input is not periodic; give its period in samples, or choose another method")
    if len(every) > 1:
        _require_one_experiment(every, period)
    if period is not None and method in ("auto", "periodic"):
        return _finished(from_periods(signals, period, interval), "periodic", first, time_unit)
    # A long delay makes the phase steep: the output is advanced to the beginning of its response.
    u, y = signals[0]
    shift = min(int(_earliest_response(first) / interval), u.size // 2)
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
    """Estimate from the exact spectrum of the held input and that of the linearly interpolated output."""
    (record, *more) = records
    if method not in ("auto", "local-polynomial") or more:
        wanted = "several records" if more else f"--method {method}"
        raise DataError(
            f"{named(record)}{wanted} need one regular clock, but {reason}; use --method local-polynomial, one record "
            "at a time"
        )
    late = min(_earliest_response(record), 0.5 * record.duration)
    spectra = record_spectra(record, late, np.inf, late, keep_mean=False)
    base = 2 * np.pi / spectra.duration
    found = _delayed(local_polynomial(spectra.inputs(late), spectra.outputs, base, points, half_width, time_unit), late)
    note = (
        f"Since {reason}, the output is interpolated linearly and its spectrum is corrected for the damping; near "
        f"{np.pi / float(np.median(np.diff(record.t))):.3g} rad/{time_unit} the correction is approximate."
    )
    _require_some(found, record)
    # The spectrum of the held input is exact: there are no images.
    return _response(found, "local-polynomial", record, np.zeros(found.frequencies.size), note)


def _earliest_response(record: Record) -> float:
    """Return the time before which the output does not respond [s]."""
    hint = analyse_response(record).delay
    return hint.early if hint is not None else 0.0


def _delayed(lines: ResponseLines, delay: float) -> ResponseLines:
    return lines._replace(response=lines.response * np.exp(-1j * lines.frequencies * delay))


def _require_some(lines: ResponseLines, record: Record) -> None:
    if lines.frequencies.size < FEWEST:
        raise DataError(
            f"{named(record)}the input excites too few frequencies; record an input that switches often, a multisine or"
            " a chirp"
        )


def _finished(lines: ResponseLines, method: Estimate, record: Record, time_unit: str) -> FrequencyResponse:
    """Return the response corrected for the hold of the input."""
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
    """Return the result, with notes on missing samples and unknown phases."""
    notes = (*lines.notes, note, *_of_record(record))
    found = FrequencyResponse(*lines[:6], bias, method, record.input.hold, notes, lines.has_interval)
    unknown = int(np.count_nonzero(found.has_interval & ~found.phase_known()))
    if not unknown:
        return found
    text = (
        f"No phase at {unknown} of the {found.response.size} frequencies, because the interval of the response, or of "
        "most neighbouring frequencies, contains zero."
    )
    return replace(found, notes=(*found.notes, text))


def _of_hold(hold: Hold, frequencies: Array, bias: Array, gain: Array, time_unit: str) -> str:
    """Return a note on the effect of the hold on the estimate."""
    if hold == "band-limited":
        return (
            "Input and output are assumed to have no power above half the sampling frequency (--hold band-limited), so "
            "that sampling causes no bias."
        )
    shape = "constant" if hold == "zoh" else "linear"
    text = f"The input is assumed {shape} between its samples (--hold {hold}), and the response is corrected for that."
    # First frequency from which on nearly all are affected, because noise makes some gains small.
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
    """Return why input and output are not on one regular clock; None if they are."""
    signal = record.input
    if record.interval is None:
        return "the clock is irregular"
    if record.valid.mean() < 1.0 - MOST_MISSING:
        return f"{100 * (1 - record.valid.mean()):.3g} % of the output samples are missing"
    inside = signal.t[(signal.t > record.t[0]) & (signal.t <= record.t[-1])]
    places = (inside - record.t[0]) / record.interval
    moves = bool(np.abs(places - np.round(places)).max(initial=0.0) > ON_GRID)
    return "the input changes between the instants of the output" if moves else None


def _common_period(inputs: list[Array]) -> int | None:
    found = {find_period(u) for u in inputs}
    return found.pop() if len(found) == 1 else None


def _require_one_experiment(records: list[Record], period: int | None) -> None:
    """Raise an error if records are not realisations of one periodic experiment."""
    first = records[0]
    if period is None:
        raise DataError(
            f"{len(records)} records must be realisations of one periodic input, but they do not all have the same "
            "period; give the period in samples, or one record at a time"
        )
    for record in records[1:]:
        same = abs((record.interval or 0.0) - (first.interval or 0.0)) <= REGULARITY * (first.interval or 0.0)
        if not same or record.input.hold != first.input.hold:
            raise DataError(f"{named(record)}its clock or hold differs from that of {first.name or 'the first record'}")
