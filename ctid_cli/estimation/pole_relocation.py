r"""Poles of a sum of modes from the spectra of a record: found one at a time, then moved together.

At the lines of a finite record the output of ``G = sum R_i/(s - p_i)`` obeys, with the transient of the states at both
ends of the window as a second numerator over the same poles and V the noise,

.. math:: Y = \sum_i \frac{r_i U + t_i}{s - p_i} + V, \qquad s = j\omega .

For given poles this is linear. Poles are moved as in vector fitting: with ``\sigma = 1 + sum c_i/(s - p_i)``,

.. math:: \sigma Y = \sum_i \frac{r_i U + t_i}{s - p_i}

is linear in r, t and c, and the zeros of sigma are better poles. Least squares would be biased by the noise in
``sigma Y``; with the fitted output in the place of Y as instrument, a fixed point (c = 0) is a stationary point of the
squared output error, as in refined instrumental variables.

References
----------
B. Gustavsen and A. Semlyen, "Rational approximation of frequency domain responses by vector fitting", *IEEE Trans.
Power Delivery* 14 (1999) 1052-1061. doi:10.1109/61.772353
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ctid_cli.arrays import Array, ComplexArray, IndexArray
from ctid_cli.errors import DataError
from ctid_cli.filtering.spectra import record_spectra
from ctid_cli.signals.record import Record, beginning

#: Longer records are searched in their first samples only: poles need not be exact, and the work stays bounded.
LONGEST_STRETCH = 8192
#: Neighbouring lines over which noise is told from a smooth response and transient.
LOCAL_LINES = 12
LOCAL_DEGREE = 2
#: A band of that many lines counts as excited by the input from this ratio of explained to noise power on.
CLEARLY_EXPLAINED = 10.0
#: Lines are kept up to the highest clearly explained frequency times this: weaker modes may lie beyond it. Of a
#: short record no fewer than this many are kept.
HEADROOM = 2.5
FEWEST_LINES = 128
#: Moves of all poles after each new mode, and after the last.
MOVES_BETWEEN = 4
MOVES_AT_THE_END = 15
#: Poles are settled when none moves by more than this fraction of its magnitude.
SETTLED = 1e-4
#: Peaks at each resolution, how many of all are tried, and with which dampings as fractions of their width.
PEAKS = 3
MOST_PEAKS = 10
DAMPINGS = (0.15, 0.5)
#: Real poles that are tried, spread over the band.
REAL_POLES = 25
#: Directions of a Gram matrix weaker than this fraction of the strongest are rounding.
RANK_TOLERANCE = 1e-14
#: Gram matrices up to this condition number leave rounding without a second round.
WELL_CONDITIONED = 1e4
#: Least damping ratio of a moved pole [-].
LEAST_DAMPING = 1e-6


@dataclass(frozen=True, eq=False)
class Lines:
    """Weighted spectra of a stretch of a record."""

    #: Equidistant frequencies [rad/s], without zero, shape (K,).
    frequencies: Array
    #: Spectra of delayed input and output times the weights, shape (K,).
    inputs: ComplexArray
    outputs: ComplexArray
    #: Reciprocal noise levels; also what the weights make of a transient, shape (K,).
    weights: Array
    #: Spectrum of what a direct feed-through adds to the output, weighted likewise; empty where there is none, shape
    #: (K,).
    direct: ComplexArray
    integrators: int

    @property
    def s(self) -> ComplexArray:
        """``j w`` [rad/s]."""
        return np.asarray(1j * self.frequencies, dtype=np.complex128)

    def weighted(self, weights: Array) -> Lines:
        """The same lines with other weights."""
        weights = weights / float(np.median(weights))
        change = weights / self.weights
        direct = self.direct * change if self.direct.size else self.direct
        return replace(self, inputs=self.inputs * change, outputs=self.outputs * change, weights=weights, direct=direct)

    def lowest(self, count: int) -> Lines:
        """The lines of the lowest frequencies."""
        spectra = ("frequencies", "inputs", "outputs", "weights", "direct")
        return replace(self, **{name: getattr(self, name)[:count] for name in spectra})


def spectral_lines(record: Record, delay: float, integrators: int = 0, direct: bool = False) -> Lines | None:
    """Spectra from which poles can be found."""
    try:
        stretch = beginning(record, LONGEST_STRETCH)
        spectra = record_spectra(stretch, delay, np.inf, delay, keep_mean=False)
    except DataError:
        return None
    count = spectra.frequencies.size
    through = np.zeros(0, dtype=np.complex128)
    if direct:
        # Spectra join the samples of an output by straight lines: what feeds through has to be taken likewise.
        sampled = Record(stretch.t, stretch.input.at(stretch.t - delay), stretch.input)
        through = record_spectra(sampled, delay, np.inf, delay, keep_mean=False).outputs
    lines = Lines(spectra.frequencies, spectra.inputs(delay), spectra.outputs, np.ones(count), through, integrators)
    if count < 2 * LOCAL_LINES:
        return lines
    edges, noise, explained = _local_fits(lines)
    clear = np.flatnonzero(explained > CLEARLY_EXPLAINED * _median_of_neighbours(noise))
    if not clear.size:
        return lines
    return lines.lowest(int(min(max(HEADROOM * edges[clear[-1] + 1], FEWEST_LINES), count)))


def local_weights(lines: Lines) -> Array:
    """Reciprocal noise levels, from what no locally smooth response and transient explain."""
    if lines.frequencies.size < 2 * LOCAL_LINES:
        return np.ones(lines.frequencies.size)
    edges, noise, _ = _local_fits(lines)
    return _weights(lines.frequencies, edges, _median_of_neighbours(noise))


def residual_weights(lines: Lines, poles: Sequence[complex]) -> Array:
    """Reciprocal noise levels, from what a fit with given poles leaves."""
    residual = _complex(_residual(lines, poles)[0]) / lines.weights
    edges = _edges(residual.size)
    noise = np.add.reduceat(np.abs(residual) ** 2, edges[:-1]) / np.diff(edges)
    return _weights(lines.frequencies, edges, noise)


def find_poles(lines: Lines, pairs: int, reals: int) -> list[complex]:
    """Poles of the modes that explain most of the output.

    Greedy: candidates for the next mode come from the peaks of the power that a locally constant gain explains of the
    residual, at several resolutions; that which would lower the squared error most is taken, and all poles found so far
    are moved before the next is looked for.
    """
    poles: list[complex] = []
    while pairs or reals:
        residual, basis = _residual(lines, poles)
        candidates = _candidates(lines, _complex(residual), pairs > 0, reals > 0)
        gains = [_gain(lines, residual, basis, pole) for pole in candidates]
        best = candidates[int(np.argmax(gains))]
        pairs, reals = (pairs - 1, reals) if best.imag else (pairs, reals - 1)
        poles = relocate(lines, [*poles, best], MOVES_BETWEEN)
    return relocate(lines, poles, MOVES_AT_THE_END)


def relocate(lines: Lines, poles: Sequence[complex], moves: int) -> list[complex]:
    """Move all poles together towards a smaller squared error."""
    current = list(poles)
    best, least = current, np.inf
    for move in range(moves + 1):
        residual, known = _residual(lines, current)
        error = float(residual @ residual)
        if error < least:
            best, least = current, error
        moved = _moved(lines, current, residual, known) if move < moves else None
        if moved is None:
            break
        settled = [abs(new - old) <= SETTLED * abs(old) for new, old in zip(moved, current, strict=False)]
        current, before = moved, len(current)
        if all(settled) and len(moved) == before:
            break
    return sorted(best, key=abs)


def _moved(lines: Lines, poles: list[complex], residual: Array, known: Array) -> list[complex] | None:
    """Zeros of sigma, reflected into the left half-plane; None where the equations are singular."""
    from scipy.linalg import block_diag  # slow to import

    basis = _basis(lines.s, poles)
    fitted = lines.outputs - _complex(residual)
    instruments = _stacked(basis * fitted[:, None])
    regressors = _stacked(basis * lines.outputs[:, None])
    regressors -= known @ (known.T @ regressors)
    left, right = _norms(instruments), _norms(regressors)
    try:
        c = -np.linalg.solve((instruments / left).T @ (regressors / right), (instruments / left).T @ residual) / right
    except np.linalg.LinAlgError:
        return None
    if not np.isfinite(c).all():
        return None
    sections = [[[p.real, p.imag], [-p.imag, p.real]] if p.imag else [[p.real]] for p in poles]
    entry = np.concatenate([[2.0, 0.0] if pole.imag else [1.0] for pole in poles])
    roots = np.linalg.eigvals(block_diag(*sections) - np.outer(entry, c))
    damping = np.maximum(np.abs(roots.real), LEAST_DAMPING * np.abs(roots))
    # Poles that run out of the band would leave the equations singular.
    low, high = 0.1 * lines.frequencies[0], 10.0 * lines.frequencies[-1]
    size = np.maximum(np.abs(roots), 1e-300)
    stable = (-damping + 1j * roots.imag) * (np.clip(size, low, high) / size)
    return sorted((complex(root) for root in stable if root.imag >= 0), key=abs)


def _residual(lines: Lines, poles: Sequence[complex]) -> tuple[Array, Array]:
    """What the best numerators leave of the output, and an orthonormal basis of what they can explain."""
    columns = _fixed_columns(lines)
    if poles:
        basis = _basis(lines.s, poles)
        columns += [basis * lines.inputs[:, None], basis * lines.weights[:, None]]
    output = _stacked(lines.outputs)
    if not columns:
        return output, np.zeros((output.size, 0))
    known = _orthonormal(_stacked(np.hstack(columns)))
    return output - known @ (known.T @ output), known


def _fixed_columns(lines: Lines) -> list[ComplexArray]:
    """Columns without unknown poles: integrators with their transient, and a direct feed-through."""
    columns: list[ComplexArray] = []
    if lines.integrators:
        powers = np.asarray(lines.s[:, None] ** -np.arange(1.0, lines.integrators + 1), dtype=np.complex128)
        columns += [powers * lines.inputs[:, None], powers * lines.weights[:, None]]
    return [*columns, lines.direct[:, None]] if lines.direct.size else columns


def _candidates(lines: Lines, residual: ComplexArray, pairs: bool, reals: bool) -> list[complex]:
    """Poles that may be next."""
    spacing = float(lines.frequencies[0])
    found: list[complex] = []
    if reals:
        found += [complex(-w) for w in np.geomspace(0.5 * spacing, lines.frequencies[-1], REAL_POLES)]
    if not pairs:
        return found
    cross, power = residual * lines.inputs.conj(), np.abs(lines.inputs) ** 2
    peaks: list[tuple[float, int, int]] = []
    width = 3
    while width == 3 or width <= residual.size // 2:
        explained = np.abs(_moving_sum(cross, width)) ** 2
        explained /= np.maximum(_moving_sum(power, width).real, 1e-12 * width * float(power.max()) + 1e-300)
        padded = np.concatenate(([-np.inf], explained, [-np.inf]))
        maxima = np.flatnonzero((explained >= padded[:-2]) & (explained > padded[2:]))
        highest = maxima[np.argsort(-explained[maxima])[:PEAKS]]
        peaks += [(float(explained[k]), int(k), width) for k in highest]
        width = 2 * width - 1
    for _, place, width in sorted(peaks, reverse=True)[:MOST_PEAKS]:
        found += [complex(-part * width * spacing, lines.frequencies[place]) for part in DAMPINGS]
    return found


def _moving_sum(values: NDArray[np.generic], width: int) -> ComplexArray:
    """Sums over an odd number of neighbours, fewer at the ends."""
    total = np.concatenate(([0.0], np.cumsum(values)))
    place = np.arange(values.size)
    half = width // 2
    return np.asarray(total[np.minimum(place + half + 1, values.size)] - total[np.maximum(place - half, 0)])


def _gain(lines: Lines, residual: Array, known: Array, pole: complex) -> float:
    """By how much one more pole (pair) would lower the squared error."""
    basis = _basis(lines.s, [pole])
    columns = _stacked(np.hstack((basis * lines.inputs[:, None], basis * lines.weights[:, None])))
    columns /= _norms(columns)
    along = known.T @ columns
    gram, slope = columns.T @ columns - along.T @ along, columns.T @ residual
    return float(slope @ np.linalg.lstsq(gram, slope, rcond=RANK_TOLERANCE)[0])


def _basis(s: ComplexArray, poles: Sequence[complex]) -> ComplexArray:
    """``1/(s - p)`` of each real pole and two real combinations of each pair, shape (K, n)."""
    columns = []
    for pole in poles:
        one = 1.0 / (s - pole)
        if pole.imag:
            other = 1.0 / (s - pole.conjugate())
            columns += [one + other, 1j * (one - other)]
        else:
            columns.append(one)
    return np.stack(columns, axis=1)


def _stacked(values: ComplexArray) -> Array:
    return np.concatenate((values.real, values.imag))


def _complex(stacked: Array) -> ComplexArray:
    half = stacked.size // 2
    return np.asarray(stacked[:half] + 1j * stacked[half:])


def _norms(columns: Array) -> Array:
    norms: Array = np.sqrt(np.einsum("ij,ij->j", columns, columns))
    return np.where(norms > 0, norms, 1.0)


def _orthonormal(columns: Array) -> Array:
    """Orthonormal basis; columns are scaled first, since those of high powers of a frequency would drown others."""
    # Many rows and few columns: Gram matrices are several times faster than Householder's reflections; where rounding
    # matters, a second round makes up for it.
    basis, condition = _nearly_orthonormal(columns / _norms(columns))
    return _nearly_orthonormal(basis)[0] if condition > WELL_CONDITIONED else basis


def _nearly_orthonormal(columns: Array) -> tuple[Array, float]:
    """Orthonormal up to rounding times the condition number of the Gram matrix, and that number."""
    values, vectors = np.linalg.eigh(columns.T @ columns)
    kept = values > RANK_TOLERANCE * values[-1]
    return columns @ (vectors[:, kept] / np.sqrt(values[kept])), float(values[-1] / values[kept][0])


# --- noise level -----------------------------------------------------------------------------------


def _edges(count: int) -> IndexArray:
    """Where blocks of equally many neighbouring lines begin; the last takes the rest too."""
    edges = LOCAL_LINES * np.arange(max(count // LOCAL_LINES, 1) + 1)
    edges[-1] = count
    return edges


def _local_fits(lines: Lines) -> tuple[IndexArray, Array, Array]:
    """Blocks of lines, the variance that polynomials in w leave in each, and the power per line of the response."""
    edges = _edges(lines.frequencies.size)
    blocks = (edges.size - 1, LOCAL_LINES)
    inputs = lines.inputs[: blocks[0] * blocks[1]].reshape(blocks)
    outputs = lines.outputs[: blocks[0] * blocks[1]].reshape(blocks)
    powers = np.linspace(-1.0, 1.0, LOCAL_LINES)[:, None] ** np.arange(LOCAL_DEGREE + 1)
    transient = np.linalg.qr(powers)[0]
    without = np.eye(LOCAL_LINES) - transient @ transient.T
    outputs = outputs @ without
    response, strength, _ = np.linalg.svd(without @ (powers * inputs[:, :, None]), full_matrices=False)
    excited = strength > 1e-9 * np.maximum(strength[:, :1], 1e-300)
    follows = np.where(excited, np.einsum("kij,ki->kj", response.conj(), outputs), 0.0)
    number = excited.sum(axis=1)
    explained = np.sum(np.abs(follows) ** 2, axis=1)
    left = np.sum(np.abs(outputs) ** 2, axis=1) - explained
    free = LOCAL_LINES - powers.shape[1] - number
    return edges, np.maximum(left, 0.0) / free, explained / np.maximum(number, 1)


def _median_of_neighbours(levels: Array) -> Array:
    """Running median over five blocks: what a resonance narrower than a block leaves is no noise."""
    if levels.size < 3:
        return levels
    padded = np.pad(levels, 2, mode="reflect")
    return np.asarray(np.median(np.lib.stride_tricks.sliding_window_view(padded, 5), axis=1))


def _weights(frequencies: Array, edges: IndexArray, noise: Array) -> Array:
    """Reciprocal standard deviations, with straight lines between the blocks in logarithmic scales."""
    centres = 0.5 * (frequencies[edges[:-1]] + frequencies[edges[1:] - 1])
    floor = 1e-24 * float(noise.max()) + 1e-300
    level = np.interp(np.log(frequencies), np.log(centres), np.log(np.maximum(noise, floor)))
    return np.asarray(np.exp(-0.5 * level))
