"""Synchrophasors of a record: phasor, frequency and rate of change of frequency at the reporting instants."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctid_cli.arrays import Array, BoolArray, ComplexArray, IntArray
from ctid_cli.errors import DataError
from ctid_cli.frequency.flags import Flag
from ctid_cli.frequency.inputs import LARGEST_SAMPLE
from ctid_cli.frequency.synchrophasor_filters import (
    POINTS,
    PerformanceClass,
    SynchrophasorFilters,
    design_filters,
    frequency_range,
)
from ctid_cli.frequency.synchrophasor_kernel import measure_phasors
from ctid_cli.signals.checks import require_finite, require_positive
from ctid_cli.text import ShownAsTable

#: Samples that a cycle must have at least.
FEWEST_SAMPLES = 12
#: A tone this much smaller than the largest sample is none.
SMALLEST_TONE = 1e-6
#: What makes a row invalid, in words for the user.
SYNCHROPHASOR_REASONS = {
    Flag.GAP: "A sample within the window is missing or not finite.",
    Flag.ABSENT: "There is no tone near the nominal frequency.",
    Flag.OUT_OF_BOUNDS: "The frequency is outside the range of the class, where the standard says nothing of errors.",
    Flag.CHANGE: (
        "Within the window the signal is no single tone that changes smoothly: a step, another tone between the "
        "harmonics, or noise may move the phasor by 1 % and more."
    ),
}
#: Makes of three phases their positive sequence, in which the second lags by a third of a cycle; its conjugate makes
#: the negative one.
POSITIVE_SEQUENCE = np.exp(2j * np.pi * np.arange(3) / 3.0) / 3.0


@dataclass(frozen=True, eq=False)
class SynchrophasorTrack(ShownAsTable):
    """Synchrophasors at the reporting instants, rows of one or three phases.

    Parameters
    ----------
    t : ndarray, shape (N,)
        Reporting instants: whole multiples of ``1/reporting_rate`` on the record's clock [s].
    phasor : ndarray of complex, shape (N,)
        Root mean square [signal unit], and phase against a cosine of the nominal frequency that has its maximum at
        ``t = 0`` [rad]. Of three phases the positive sequence.
    phases : ndarray of complex, shape (N, C)
        The same for each phase.
    frequency : ndarray, shape (N,)
        Slope of the phase [Hz].
    rocof : ndarray, shape (N,)
        Rate of change of the frequency [Hz/s].
    error : ndarray, shape (N,)
        The largest phasor that the model leaves anywhere within the window, over the tone's [%].
    flags : ndarray of int, shape (N,)
        Why a row is not valid, bits of :class:`Flag`: 0 where it is.
    nominal : int
        Nominal frequency [Hz].
    performance_class : {"P", "M"}
        Class.
    reporting_rate : int
        Rows in a second [1/s].
    latency : float
        Half the longest window [s]: so long after its instant a row can be computed.
    """

    t: Array
    phasor: ComplexArray
    phases: ComplexArray
    frequency: Array
    rocof: Array
    error: Array
    flags: NDArray[np.uint16]
    nominal: int
    performance_class: PerformanceClass
    reporting_rate: int
    latency: float

    @property
    def valid(self) -> BoolArray:
        """Rows without a flag, shape (N,)."""
        return np.asarray(self.flags == 0)


def measure_synchrophasors(
    samples: ArrayLike,
    interval: float,
    *,
    start: float = 0.0,
    nominal: int = 50,
    performance_class: PerformanceClass = "P",
    reporting_rate: int | None = None,
) -> SynchrophasorTrack:
    """Measure phasor, frequency and rate of change of frequency of a mains signal.

    Around every reporting instant the signal is taken as ``Re[p(t) exp(2 pi j f t)]`` with ``p`` a polynomial of second
    degree, ``f`` the tone's own frequency; class P looks at less than two cycles on both sides, class M at less than
    ``7/reporting_rate``.

    Parameters
    ----------
    samples : array_like, shape (N,) or (N, 3)
        One signal, or three phases in the order of the positive sequence [signal unit]; NaN where a sample is missing.
    interval : float
        Sampling interval [s]; at least 12 samples to a nominal cycle. Samples and reports need no common clock.
    start : float, default 0
        Instant of the first sample [s]. Angles are those of the standard if the record's times count from a full
        second of UTC.
    nominal : {50, 60}, default 50
        Nominal frequency [Hz].
    performance_class : {"P", "M"}, default "P"
        P answers fast; M rejects what lies outside the band of the reporting rate.
    reporting_rate : int, optional
        Rows in a second; the nominal frequency if not given. 10, 25, 50 or 100 at 50 Hz; 10, 12, 15, 20, 30, 60 or 120
        at 60 Hz.

    Returns
    -------
    SynchrophasorTrack
        A row for every instant whose window lies within the record.

    Raises
    ------
    DataError
        If the samples have another shape, a cycle has too few of them, or the record is too short.
    OptionError
        If the standard has no such nominal frequency, class or reporting rate.

    Notes
    -----
    With kernels ``h_i(u)`` that are zero at all harmonics, ``u`` the time in cycles of the tone, the equations
    ``sum h_i(u) exp(-2 pi j u) (x - Re[(p0 + p1 u + p2 u^2/2) exp(2 pi j u)]) = 0`` are solved, again until ``u`` is
    that of the tone's own frequency. A steady tone, whatever its frequency, and its image are thus met exactly.

    References
    ----------
    IEC/IEEE 60255-118-1:2018, Measuring relays and protection equipment, Part 118-1: Synchrophasor for power systems.

    Examples
    --------
    >>> import numpy as np
    >>> t = np.arange(0.0, 0.5, 1 / 5000)
    >>> track = measure_synchrophasors(230 * np.sqrt(2) * np.cos(2 * np.pi * 50.5 * t + 0.3), 1 / 5000)
    >>> [round(float(value[5]), 6) for value in (abs(track.phasor), track.frequency)]
    [230.0, 50.5]
    """
    reporting_rate = nominal if reporting_rate is None else reporting_rate
    filters = design_filters(nominal, performance_class, reporting_rate)
    require_positive("interval", interval, "s")
    require_finite("start", start, "s")
    values = _channels(samples)
    if interval * nominal > 1.0 / FEWEST_SAMPLES:
        few = f"{1.0 / (interval * nominal):.3g} samples to a cycle of {nominal} Hz are too few"
        raise DataError(f"{few}: {FEWEST_SAMPLES} are needed, a sampling rate of {FEWEST_SAMPLES * nominal} Hz")
    checking = _checking_filters(filters, nominal, performance_class)
    half = longest_half_window(checking, nominal, performance_class, reporting_rate)
    end = start + (values.shape[0] - 1) * interval
    # A report at the very end of the record may lie outside by rounding alone.
    slack = 1e-6 * interval
    first = math.ceil((start + half - slack) * reporting_rate)
    last = math.floor((end - half + slack) * reporting_rate)
    if last < first:
        short = f"the record lasts {end - start:.4g} s, and the window of a report {2.0 * half:.4g} s"
        raise DataError(f"{short}: there is no reporting instant with all of its window within the record")
    t = np.arange(first, last + 1) / reporting_rate
    return measure_at(values, interval, start, t, nominal, performance_class, reporting_rate)


def _checking_filters(
    filters: SynchrophasorFilters, nominal: int, performance_class: PerformanceClass
) -> SynchrophasorFilters:
    """Filters that say whether a row is valid: never shorter than those of class P at the nominal rate."""
    usual = design_filters(nominal, performance_class, nominal)
    return usual if performance_class == "P" and filters.half_cycles < usual.half_cycles else filters


def longest_half_window(
    filters: SynchrophasorFilters, nominal: int, performance_class: PerformanceClass, reporting_rate: int
) -> float:
    """Half the window at the lowest frequency that a window is scaled to [s]."""
    return filters.half_cycles / (nominal - frequency_range(performance_class, reporting_rate))


def measure_at(
    values: Array,
    interval: float,
    start: float,
    t: Array,
    nominal: int,
    performance_class: PerformanceClass,
    reporting_rate: int,
) -> SynchrophasorTrack:
    """Synchrophasors at any instants [s] of samples of shape (N, C)."""
    filters = design_filters(nominal, performance_class, reporting_rate)
    checking = _checking_filters(filters, nominal, performance_class)
    furthest = frequency_range(performance_class, reporting_rate)
    weights: ComplexArray = np.asarray(POSITIVE_SEQUENCE if values.shape[1] == 3 else [1.0], np.complex128)
    values, places = np.ascontiguousarray(values), (t - start) / interval

    def measure(kernels: SynchrophasorFilters) -> tuple[ComplexArray, Array, Array, Array, IntArray]:
        clock, tables = (1.0 / interval, float(nominal), furthest), (kernels.tables, kernels.half_cycles, POINTS)
        return measure_phasors(values, places, *clock, *tables, kernels.checks, kernels.curved, weights)

    found, frequency, rocof, left, wrong = measure(filters)
    if checking is not filters:
        # Two cycles leave next to nothing to check: what four cycles say counts as well.
        slower, *_, left, wrong = measure(checking)
        left = np.maximum(left, np.abs((slower - found) @ weights) / np.abs(found @ weights))
    # Turned back by whole cycles first: the fraction of f0 t keeps its digits, however late the instant.
    phases = found * np.exp(-2j * np.pi * np.mod(nominal * t, 1.0))[:, None] / math.sqrt(2.0)
    phasor = phases @ weights
    size = float(np.nanmax(np.abs(values)))
    with np.errstate(invalid="ignore"):
        flags = np.where(wrong == 1, int(Flag.GAP), 0)
        flags |= np.where((wrong == 2) | (np.abs(phasor) < SMALLEST_TONE * size), int(Flag.ABSENT), 0)
        # Rounding may put a tone at the very end of the range beyond it.
        flags |= np.where(np.abs(frequency - nominal) > furthest + 1e-3, int(Flag.OUT_OF_BOUNDS), 0)
        flags |= np.where(left > checking.largest_left, int(Flag.CHANGE), 0)
    return SynchrophasorTrack(
        t=t,
        phasor=phasor,
        phases=phases,
        frequency=frequency,
        rocof=rocof,
        error=100.0 * left,
        flags=flags.astype(np.uint16),
        nominal=nominal,
        performance_class=performance_class,
        reporting_rate=reporting_rate,
        latency=longest_half_window(filters, nominal, performance_class, reporting_rate),
    )


def _channels(samples: ArrayLike) -> Array:
    """Samples of shape (N, 1) or (N, 3), with NaN for whatever counts as missing."""
    values = np.asarray(samples)
    if (
        values.dtype.kind not in "fiu"
        or values.ndim not in (1, 2)
        or (values.ndim == 2 and values.shape[1] not in (1, 3))
    ):
        found = f"shape {values.shape} and type {values.dtype}"
        raise DataError(f"the samples must be real numbers of shape (N,) or, for three phases, (N, 3), not of {found}.")
    values = values.astype(np.float64).reshape(values.shape[0], -1)
    with np.errstate(invalid="ignore"):
        values = np.where(np.abs(values) <= LARGEST_SAMPLE, values, np.nan)
    if not np.isfinite(values).any():
        raise DataError("no sample is a finite number")
    return values
