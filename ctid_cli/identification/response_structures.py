"""Structures of a model of a frequency response, each fitted from smaller ones, and what lines say by themselves."""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array, ComplexArray, IntArray
from ctid_cli.errors import DataError, OptionError
from ctid_cli.estimation.delay_search import lowest_minima
from ctid_cli.estimation.measured_lines import MeasuredLines, lines_of
from ctid_cli.estimation.optimum.best_model import best_of_orders
from ctid_cli.estimation.optimum.box import Point, box_of, point_of
from ctid_cli.estimation.optimum.starts import QUICK, StructureSearch, with_added_poles
from ctid_cli.estimators.frequency_domain import FrequencyDomain, FrequencyDomainFit, fit_of_lines
from ctid_cli.identification.choice import UNDAMPED, Given, Span
from ctid_cli.inference.covariance import LARGEST_CONDITION
from ctid_cli.inference.residual_tests import all_white
from ctid_cli.signals.frequency_data import FrequencyData
from ctid_cli.text import count, listed

#: Fewest real equations for each parameter.
EQUATIONS_EACH = 3
#: Squared errors below this share of the squared values are rounding.
ROUNDING = 1e-20
#: Ratio of the squared errors of a fit to the noise between neighbouring lines up to which it misses no peak, and
#: number of lines for a local variance.
WHITE, LOCAL = 1.3, 15
#: Peaks of the errors, and dampings beside that of two lines, from which searches start.
TRIED_PEAKS, DAMPINGS = 4, (0.02, 0.1)
#: The range of the delay ends at this multiple of the greatest slope of the phase of at least this number of
#: neighbouring lines, whose values are at least this multiple of their standard errors.
REACH, NEIGHBOURS, ABOVE_NOISE = 1.5, 10, 5.0
#: Standard errors by which a peak stands out of its surroundings.
CLEAR = 8.0


class Judged(NamedTuple):
    """A structure with its fit, its criterion, and its errors at lines that are held back."""

    #: Poles, zeros and integrators, as ``2/1`` or ``1/0 + 1``.
    name: str
    #: Poles, integrators included.
    order: int
    parameters: int
    options: FrequencyDomain
    fit: FrequencyDomainFit
    criterion: float = float("nan")
    #: Mean squared weighted error of held-back lines over that of the best fit [-]; NaN if it was not computed.
    held_back: float = float("nan")
    #: Mean over blocks of the logarithm of its ratio to that of the structure of least criterion, and standard error.
    difference: float = float("nan")
    standard_error: float = float("nan")
    #: Whether it is chosen.
    taken: bool = False

    @property
    def admissible(self) -> bool:
        """Whether the data determine it, and no pole pair is at a bound of ``UNDAMPED``."""
        box, held = self.fit.box, self.fit.held_poles
        undamped = box is not None and any(UNDAMPED.intersection(box.met_by(pole)) for pole in held)
        return self.fit.condition_number <= LARGEST_CONDITION and not undamped

    @property
    def words(self) -> str:
        """The structure in words."""
        return spelled(self.options)


def spelled(options: FrequencyDomain) -> str:
    """Return a structure in words."""
    parts = [count(options.poles, "pole"), count(options.zeros, "zero") if options.zeros else "no zero"]
    parts += [count(options.integrators, "integrator")] * bool(options.integrators)
    return f"{listed(parts)}, {'with' if options.delay_bounds[1] else 'without'} a delay"


class Family:
    """Structures with one number of integrators and one range of the delay."""

    def __init__(
        self, data: FrequencyData, options: FrequencyDomain, given: Given, noise: float, near: "Family | None" = None
    ) -> None:
        #: Mean square of a weighted real part of the noise; and a family with a free delay, from which searches start.
        self.noise, self.near = noise, near
        #: Family without a delay, whose minima are starts too.
        self.undelayed: Family | None = None
        if near is not None:
            near.undelayed = self
        self.data, self.options, self.given = data, options, given
        measured = options.prepare(data).laid_out
        assert isinstance(measured, MeasuredLines)
        self.measured = measured
        self.search = StructureSearch(measured.problem, box_of(measured.problem, options.delay_bounds), effort=QUICK)
        #: Why a structure cannot have the known and bounded parameters.
        self.refusal: Exception | None = None
        self.searched = set[tuple[int, int]]()

    def tried(self, order: int, span: Span, *, proper: bool) -> Iterator[Judged]:
        """Yield all structures of an order, integrators included; ``proper`` ones have more poles than zeros."""
        for structure in span.structures(order, self.options.integrators, proper):
            found = self._fit(*structure)
            if found is not None:
                yield found

    def _fit(self, poles: int, zeros: int) -> Judged | None:
        """Fit a structure; None if there are too few lines, or it does not have the known parameters."""
        options = replace(self.options, poles=poles, zeros=zeros)
        laid_out, known = self.measured.with_degrees(options.order, [zeros]), len(self.given.fixed or ())
        size = laid_out.layout.size - options.integrators - known
        if EQUATIONS_EACH * size > self.measured.lines.count:
            return None
        if self.given.fixed or self.given.bounds:
            try:
                options = replace(options, fixed=self.given.fixed, bounds=self.given.bounds)
                fit = options.prepare(self.data).minimum()
            except (OptionError, DataError) as error:
                self.refusal = error
                return None
        else:
            for n in range(int(not options.integrators), poles + 1):
                for m in range(min(zeros, n + self.search.most_zeros) + 1):
                    self._searched(n, m)
            fit = fit_of_lines(laid_out, best_of_orders(self.search, poles, zeros), self.data)
        assert isinstance(fit, FrequencyDomainFit)
        integrators = f" + {options.integrators}" if options.integrators else ""
        return Judged(f"{poles}/{zeros}{integrators}", options.order, size, options, fit)

    def _searched(self, poles: int, zeros: int) -> None:
        """Search a structure from nested ones, and from pairs at the peaks of their errors."""
        if (poles, zeros) in self.searched:
            return
        self.searched.add((poles, zeros))
        if self.near is not None and self.near.search.minima(poles, zeros):
            point = self.near.search.best(poles, zeros)
            points = [point_of(point.poles, self.search.box.middle, self.search.box)]
            points += [self.search.best(poles, zeros - 1)] if zeros else []
            self.search.refine(poles, zeros, points)
            return
        self.search.climb(poles, zeros)
        if self.search.minima(poles, zeros)[0].squared_error > WHITE * self.noise * self.measured.lines.count:
            self.search.refine(poles, zeros, self._at_peaks(poles, zeros))
        if self.undelayed is not None:
            self.undelayed._searched(poles, zeros)
            best = self.undelayed.search.best(poles, zeros)
            self.search.refine(poles, zeros, [point_of(best.poles, self.search.box.each_delay[0][:1], self.search.box)])

    def _at_peaks(self, poles: int, zeros: int) -> list[Point]:
        """Return the two best starts with a pair at a peak of the errors of a structure with two poles less."""
        m, lines = min(zeros, poles - 2 + self.search.most_zeros), self.measured.lines
        below = self.search.minima(poles - 2, m)
        if poles < 2 or m < 0 or (poles > 2 and not below):
            return []
        errors, roots, delay = lines.weights * lines.response, np.zeros(0, dtype=complex), self.search.box.middle
        if below:
            degrees = poles - 2 + self.options.integrators, [m]
            near = self.measured.with_degrees(*degrees)
            start = np.atleast_1d(np.poly(below[0].point.poles).real), below[0].point.seconds
            errors = complex_errors(self.measured, near.errors(near.local(start))[0])
            roots, delay = below[0].point.poles, below[0].point.seconds
        w, size = lines.frequencies, np.abs(errors)
        gaps = np.gradient(w) if w.size > 1 else w
        points = []
        for k in lowest_minima(-size, TRIED_PEAKS):
            if w[k] > 0.0:
                dampings = [float(np.clip(gaps[k] / w[k], 2.0 * self.search.box.least_damping, 0.5)), *DAMPINGS]
                base, descent = (roots, delay), self.search.descent(zeros)
                points += with_added_poles(descent, self.search.box, base, [float(w[k])], dampings, 1)
        return self.search.descent(zeros).sorted(points)[:2]


# --- what the lines say by themselves ------------------------------------------------------------------


def greatest_delay(data: FrequencyData, scale: float) -> float:
    """Return a delay [s] beyond that of the response: a multiple of the greatest slope of its phase, and a margin.

    The slopes are those of regressions over neighbouring lines, without two standard errors. The delay is limited to
    half a turn between two lines.
    """
    lines = lines_of(data)
    size = np.abs(lines.weights * lines.response) / (np.sqrt(2.0) * scale)
    seen = (size > ABOVE_NOISE) & (lines.frequencies > 0.0)
    if np.count_nonzero(seen) < 3:
        return float(0.5 * np.pi / lines.lowest)
    w, values, size = lines.frequencies[seen], lines.response[seen], size[seen]
    phase = np.concatenate(([0.0], np.cumsum(np.angle(values[1:] * values[:-1].conj()))))
    greatest, narrowest, width = 0.0, float(np.diff(w).max()), min(NEIGHBOURS, w.size)
    while width <= w.size:
        for k in range(0, w.size - width + 1, max(width // 2, 1)):
            own = slice(k, k + width)
            weight = size[own] / size[own].max()
            centred = w[own] - np.average(w[own], weights=weight**2)
            spread = float(np.sum((weight * centred) ** 2))
            if spread > 0.0:
                slope = -float(np.sum(weight**2 * centred * phase[own])) / spread
                greatest = max(greatest, slope - 2.0 / (np.sqrt(2.0 * spread) * float(size[own].max())))
                narrowest = min(narrowest, float(np.median(np.diff(w[own]))))
        width *= 2
    return float(min(REACH * greatest + 0.5 * np.pi / w[-1], np.pi / narrowest if narrowest > 0.0 else np.inf))


def complex_errors(measured: MeasuredLines, errors: Array) -> ComplexArray:
    """Return weighted errors of real and imaginary parts as one complex number for each line."""
    both = np.zeros(measured.lines.use.size)
    both[measured.lines.use] = errors
    return np.asarray(both[: both.size // 2] + 1j * both[both.size // 2 :])


def noise_scale(w: Array, weighted: ComplexArray) -> float:
    """Return the deviation of a weighted real part, from the differences of lines from the line between neighbours."""
    least = float(np.sqrt(ROUNDING * np.mean(np.abs(weighted) ** 2)))
    if w.size < 3:
        return least
    share = np.divide(w[1:-1] - w[:-2], w[2:] - w[:-2], out=np.full(w.size - 2, 0.5), where=w[2:] > w[:-2])
    left = weighted[1:-1] - share * weighted[2:] - (1.0 - share) * weighted[:-2]
    squared = 0.5 * np.abs(left) ** 2 / (1.0 + share**2 + (1.0 - share) ** 2)
    return max(float(np.sqrt(np.median(squared) / np.log(2.0))), least)


def white_over_lines(errors: Array, lines: int) -> bool:
    """Return whether errors pass as uncorrelated over the lines, with a variance that may change over them."""
    parts, window = np.split(errors, [lines]), np.ones(LOCAL)
    if lines <= LOCAL:
        return True
    powers = (np.convolve(part**2, window, "same") / np.convolve(np.ones(part.size), window, "same") for part in parts)
    return all_white([part / np.sqrt(power + np.finfo(float).tiny) for part, power in zip(parts, powers, strict=True)])


def clear_peaks(data: FrequencyData, errors: Array) -> IntArray:
    """Return the lines at the peaks of the gain that stand out of their surroundings."""
    from scipy.signal import find_peaks

    peaks, found = find_peaks(np.abs(data.response), prominence=0.0)
    return np.asarray(peaks[found["prominences"] > CLEAR * errors[peaks]])
