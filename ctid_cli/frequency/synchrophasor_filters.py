"""The filters of a synchrophasor: even smoothing kernels and their derivatives, tabulated over cycles.

Every kernel is the running mean over a whole cycle, once or twice, of something smooth. Its frequency response is zero
at all multiples of the frequency that it is scaled to: harmonics, the offset, and the image of the tone itself.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import OptionError
from ctid_cli.signals.checks import require_choice
from ctid_cli.text import listed

#: Protection (fast) or measurement (rejects what lies between the harmonics).
PerformanceClass = Literal["P", "M"]
#: Reporting rates [1/s] of each nominal frequency [Hz]: IEEE C37.118.1-2011, Table 1, with 100/s and 120/s.
REPORTING_RATES: dict[int, tuple[int, ...]] = {50: (10, 25, 50, 100), 60: (10, 12, 15, 20, 30, 60, 120)}
#: Points of a table in each cycle.
POINTS = 512
#: Of the greatest half-length that the latency allows, 7/F_s, the kernels of class M take this much: they are longer
#: where the frequency is below its nominal value.
M_SHARE = 0.85
#: Cut-off of the sinc of class M, as a fraction of the reporting rate and at most so many hertz.
M_CUTOFF, M_HIGHEST_CUTOFF = 0.25, 14.0


@dataclass(frozen=True, eq=False)
class SynchrophasorFilters:
    """Tables over ``u`` [cycles] from ``-half_cycles`` on, ``POINTS`` to a cycle."""

    #: Kernels of the phasor, of its first and second derivative, and of the check of the model, shape (G, 4).
    tables: Array
    #: Half the length of the tables [cycles].
    half_cycles: float
    #: Where the check looks, against the instant [cycles].
    checks: Array
    #: The largest phasor that the model may leave there, as a fraction of the tone's.
    largest_left: float
    #: Whether the phasor is corrected for its curvature within its kernel.
    curved: bool


def frequency_range(performance_class: PerformanceClass, reporting_rate: int) -> float:
    """How far a steady frequency may be from its nominal value [Hz]: IEC/IEEE 60255-118-1:2018, steady state."""
    return 2.0 if performance_class == "P" or reporting_rate < 10 else min(reporting_rate / 5.0, 5.0)


def require_synchrophasor(nominal: int, performance_class: str, reporting_rate: int) -> None:
    """Refuse what the standard does not have."""
    if nominal not in REPORTING_RATES:
        raise OptionError("nominal", f"nominal must be 50 or 60 Hz, not {nominal:g}.")
    require_choice("performance_class", performance_class, ("P", "M"))
    rates = REPORTING_RATES[nominal]
    if reporting_rate not in rates:
        allowed = f"at {nominal} Hz the standard has {listed(rates)}"
        raise OptionError("reporting_rate", f"{reporting_rate:g} reports a second cannot be had: {allowed}.")


@lru_cache(maxsize=32)
def design_filters(nominal: int, performance_class: PerformanceClass, reporting_rate: int) -> SynchrophasorFilters:
    """Kernels of a class at a reporting rate."""
    require_synchrophasor(nominal, performance_class, reporting_rate)
    if performance_class == "M":
        return _measurement(nominal, reporting_rate)
    return _protection(fast=reporting_rate > nominal)


def _protection(fast: bool) -> SynchrophasorFilters:
    """Kernels of class P: within one cycle on both sides of the instant, or two where the latency allows them."""
    phasor = _running_mean(_bump(0.45))
    if fast:
        # All within 0.95 cycles: 2/F_s is one cycle.
        tables = [phasor, *_derivatives(_bump(0.45)), _running_mean(_impulse())]
        return _tabulated(tables, np.linspace(-0.45, 0.45, 3), 0.01, curved=False)
    # Derivatives of the running mean of a running mean, 1.85 cycles long on both sides: harmonics are double zeros.
    bump = _bump(0.85)
    first, second = _difference(_running_mean(bump)), _difference(_difference(bump))
    tables = [phasor, first, second, _running_mean(_impulse())]
    return _tabulated(tables, np.linspace(-1.35, 1.35, 7), 0.01, curved=False)


def _measurement(nominal: int, reporting_rate: int) -> SynchrophasorFilters:
    half = M_SHARE * 7.0 * nominal / reporting_rate
    cutoff = min(M_CUTOFF * reporting_rate, M_HIGHEST_CUTOFF) / nominal
    low_pass = _windowed_sinc(half - 0.5, cutoff)
    check = _windowed_sinc(0.65 * half - 0.5, cutoff)
    tables = [_running_mean(low_pass), *_derivatives(low_pass), _running_mean(check)]
    # The fastest modulations pass these filters better than they suit the model.
    return _tabulated(tables, 0.35 * half * np.linspace(-1.0, 1.0, 3), 0.02, curved=True)


def _grid(half: float) -> Array:
    """Instants [cycles], symmetric about zero and as many to the cycle as a table has, half a cycle included."""
    points = int(half * POINTS)
    return np.arange(-points, points + 1) / POINTS


def _bump(half: float) -> Array:
    """A smooth even kernel of this half-length [cycles]."""
    return np.asarray(np.cos(0.5 * np.pi * _grid(half) / half) ** 4)


def _impulse() -> Array:
    return np.ones(1)


def _windowed_sinc(half: float, cutoff: float) -> Array:
    """Low-pass with a cut-off in units of the tone's frequency."""
    u = _grid(half)
    return np.asarray(np.sinc(2.0 * cutoff * u) * (0.54 + 0.46 * np.cos(np.pi * u / half)))


def _running_mean(kernel: Array) -> Array:
    """The kernel's mean over one cycle, by the trapezoidal rule: zero at all multiples of the frequency."""
    box = np.ones(POINTS + 1)
    box[[0, -1]] = 0.5
    return np.convolve(kernel, box / POINTS)


def _difference(kernel: Array) -> Array:
    """What one half cycle later is more than half a cycle before: the derivative of the running mean."""
    comb = np.zeros(POINTS + 1)
    comb[0], comb[-1] = 1.0, -1.0
    return np.convolve(kernel, comb)


def _derivatives(kernel: Array) -> tuple[Array, Array]:
    """First and second derivative of the running mean of a kernel, but for their scale."""
    slope = np.gradient(kernel, 1.0 / POINTS)
    return _difference(kernel), _difference(slope)


def _tabulated(tables: list[Array], checks: Array, largest_left: float, curved: bool) -> SynchrophasorFilters:
    length = max(table.size for table in tables)
    # A zero at both ends, so that interpolation needs no exception.
    stacked = np.array([np.pad(table, (length - table.size) // 2 + 1) for table in tables])
    u = (np.arange(stacked.shape[1]) - stacked.shape[1] // 2) / POINTS
    # Each yields 1 for its own power: 1, u and u^2/2.
    moments = [stacked[0].sum(), (stacked[1] * u).sum(), (stacked[2] * u * u).sum() / 2.0, stacked[3].sum()]
    stacked /= np.array(moments)[:, None]
    stacked *= POINTS
    laid_out = np.ascontiguousarray(stacked.T)
    laid_out.setflags(write=False)
    return SynchrophasorFilters(laid_out, float(u[-1]), checks, largest_left, curved)
