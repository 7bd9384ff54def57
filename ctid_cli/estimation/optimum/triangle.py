r"""The rows of all used samples of a record, reduced by orthogonal transformations to a triangle.

With Z the rows ``[z, w, u, y, free z, free w, 1, t - t_0]`` of all used samples, ``Z = Q R``: whatever is asked of
linear maps of these rows (projections, residuals, sums of squares) is asked of the same maps of R. Second moments would
square the condition; this costs little more, so that one route serves the search and its end.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.estimation.optimum.chain import Chain, Form, Fractions, Modal, Record
from ctid_cli.filtering.bank import Place
from ctid_cli.filtering.filter_data import FilterData, split_delay
from ctid_cli.filtering.frequency_lines import FrequencyLines
from ctid_cli.inference.innovations import SampledNoise, Whitener


class Delay(NamedTuple):
    """A delay, and on a regular clock the cell between two samples that it is read in, -1 for that of the delay."""

    seconds: float
    cell: int

    def place(self, interval: float) -> Place:
        """Return the breaks by which the read-out lags, and the fraction, 0 to 1, of an interval read beyond that.

        At a sample a cell is closed on both sides: each has its own slope there. Without an interval, the delay.
        """
        if not interval:
            return self.seconds
        if self.cell < 0:
            return split_delay(self.seconds, interval)
        return self.cell + 1, min(max(self.cell + 1 - self.seconds / interval, 0.0), 1.0)


class Columns(NamedTuple):
    """Where the rows of n states have what."""

    n: int
    #: Rows of w and of the free response that there are, and the powers of time beside them.
    second: int
    free: int
    trend: tuple[int, ...]

    @classmethod
    def of(cls, n: int, second: bool, free: bool, trend: tuple[int, ...]) -> "Columns":
        """Return the columns of rows with or without w and free response, and with powers of time."""
        states = 2 * n if second else n
        return cls(n, states - n, states if free else 0, trend)

    @property
    def u(self) -> int:
        """The input."""
        return self.n + self.second

    @property
    def free_z(self) -> slice:
        """Z of the free response."""
        return slice(self.u + 2, self.u + 2 + self.n)

    @property
    def free_states(self) -> slice:
        """Z and w of the free response."""
        return slice(self.u + 2, self.u + 2 + self.free)

    @property
    def size(self) -> int:
        """Number of columns."""
        return self.u + 2 + self.free + len(self.trend)

    @property
    def powers(self) -> slice:
        """Powers of the time since the first instant."""
        return slice(self.u + 2 + self.free, self.size)


def rows_of(
    form: Fractions | Chain,
    columns: Columns,
    delay: Delay,
    data: FilterData | FrequencyLines,
    period: float,
    noise: SampledNoise | None = None,
) -> Iterator[Array]:
    """Yield the rows of the used samples, transposed, piece by piece; whitened where a noise is given."""
    if isinstance(data, FrequencyLines):
        answers = form.at_lines(data, delay.place(data.interval), columns.second > 0)
        yield data.parts(np.column_stack((answers, data.response)))
        return
    whitener = None if noise is None else Whitener(noise.noise, columns.size)
    second, done, record = columns.second > 0, 0, _record(delay, data, period)
    elapsed = data.t[data.use] if columns.free or any(columns.trend) else data.t
    for forced in form.forced(record, second):
        if not len(forced):
            # A piece without outputs.
            continue
        rows = np.empty((columns.size, len(forced)))
        rows[: columns.u + 2] = forced.T
        if columns.free:
            rows[columns.free_states] = form.free(elapsed[done : done + len(forced)] - elapsed[0], second)
        for row, power in zip(rows[columns.powers], columns.trend, strict=True):
            row[:] = (elapsed[done : done + len(forced)] - data.t[0]) ** power if power else 1.0
        if noise is not None and whitener is not None:
            whitener(rows, noise.steps[done : done + len(forced)])
        done += len(forced)
        yield rows


def _reduced(triangle: Array | None, rows: Array) -> Array:
    """Return the triangle of rows, transposed and overwritten, below another triangle: R <- qr[R; rows]."""
    from scipy.linalg.lapack import dgeqrf  # slow to import

    q, whole = len(rows), rows if triangle is None else np.hstack((triangle.T, rows))
    # The transpose has the order of LAPACK: nothing is copied, unlike in ``numpy.linalg.qr``.
    factors = dgeqrf(whole.T, lwork=32 * q, overwrite_a=True)[0][:q]
    result = np.zeros((q, q))
    result[: len(factors)] = np.triu(factors)
    return result


def triangle_of(
    form: Form,
    columns: Columns,
    delay: Delay,
    data: FilterData | FrequencyLines,
    period: float,
    noise: SampledNoise | None = None,
) -> Array:
    """Return a triangle with the second moments of the rows of all used samples."""
    # Memory is that of one piece, however long the record.
    triangle: Array | None = None
    for rows in rows_of(form, columns, delay, data, period, noise):
        triangle = _reduced(triangle, rows)
    assert triangle is not None
    return triangle


def triangles_of(
    forms: list[Modal],
    columns: Columns,
    delay: Delay,
    data: FilterData | FrequencyLines,
    period: float,
    noise: SampledNoise | None = None,
) -> Array:
    """Return the triangles of several forms of one order without w, from one pass of all their modes: (K, q, q)."""
    poles, places = np.unique(np.concatenate([form.modes.poles for form in forms]), return_inverse=True)
    widths = np.where(poles.imag > 0.0, 2, 1)
    last = np.cumsum(widths)
    # Of each form the rows among those of all modes.
    each = [np.arange(last[place] - widths[place], last[place]) for place in places]
    z, n = np.concatenate(each).reshape(len(forms), columns.n), int(last[-1])
    whole = Columns.of(n, second=False, free=columns.free > 0, trend=columns.trend)
    others = np.arange(whole.size)
    chosen = [z, np.tile(others[n : n + 2], (len(forms), 1))]
    chosen += [n + 2 + z] if columns.free else []
    chosen += [np.tile(others[whole.powers], (len(forms), 1))]
    rows_of_forms = np.hstack(chosen)
    triangles: list[Array | None] = [None] * len(forms)
    for rows in rows_of(Fractions(Fractions.modes_of(poles)), whole, delay, data, period, noise):
        triangles = [_reduced(*pair) for pair in zip(triangles, rows[rows_of_forms], strict=True)]
    return np.array(triangles)


def _record(delay: Delay, data: FilterData, period: float) -> Record:
    """Return a record as it is filtered; one whose input repeats itself begins with the period before its samples."""
    if not period:
        return Record(data, delay.place(data.interval))
    place = delay.place(data.interval)
    if isinstance(place, tuple):
        shift, fraction = place
        # The last interval leads back to the first break, where the next slope begins.
        count, u = data.u.size, np.roll(data.u, shift)
        u = np.append(u, u[0])
        once = data._replace(u=u, t=np.zeros(count + 1), y=np.zeros(count), use=np.zeros(count, dtype=bool))
        return Record(data._replace(u=u), (0, fraction), period, once)
    first = data.t[0] - delay.seconds + data.slack
    earlier = period if first < data.tu[0] else 0.0
    at = int(np.searchsorted(data.tu, first + earlier, side="right")) - 1
    tu = np.concatenate((data.tu[at:], data.tu[: at + 1] + period)) - earlier
    u = np.concatenate((data.u[at:], data.u[: at + 1]))
    once = data._replace(tu=tu, u=u, t=tu[-1:], y=np.zeros(1), use=np.zeros(1, dtype=bool))
    return Record(data._replace(tu=tu, u=u), delay.seconds, period, once)
