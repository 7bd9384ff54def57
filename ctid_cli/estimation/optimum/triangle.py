r"""The rows of all used samples of a record, reduced by orthogonal transformations to a triangle.

With Z the rows ``[z, w, u, y, free z, free w, 1, t - t_0]`` of all used samples (z, w and u of each fraction where the
model is a sum of several), ``Z = Q R``: whatever is asked of
linear maps of these rows (projections, residuals, sums of squares) is asked of the same maps of R. Second moments would
square the condition; this costs little more, so that one route serves the search and its end.
"""

from collections.abc import Iterator, Sequence
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


class Channel(NamedTuple):
    """A fraction of the model: the input that drives it, and which denominator it has."""

    input: int = 0
    block: int = 0
    #: Zeros that its numerator has less than that of most.
    fewer_zeros: int = 0


#: The only fraction of a model with one input.
SINGLE = (Channel(),)
#: A delay, or one of each input.
Delays = Delay | tuple[Delay, ...]


def each_delay(delays: Delays) -> tuple[Delay, ...]:
    """Return the delay of each input."""
    return (delays,) if isinstance(delays, Delay) else delays


class Columns(NamedTuple):
    """Where the rows have what: z, w and u of each channel, y, free z and free w of each block, powers of time."""

    #: Number of states of each channel, and of the free response of each block, where there are free responses.
    orders: tuple[int, ...]
    free: tuple[int, ...]
    #: Whether there is w.
    second: bool
    trend: tuple[int, ...]

    @classmethod
    def of(
        cls,
        orders: Sequence[int],
        second: bool,
        free: bool,
        trend: tuple[int, ...],
        channels: tuple[Channel, ...] = SINGLE,
    ) -> "Columns":
        """Return the columns of blocks of some orders, with or without w and free responses."""
        each = tuple(orders[channel.block] for channel in channels)
        return cls(each, tuple(orders) if free else (), second, trend)

    def _first(self, k: int) -> int:
        """First row of a channel."""
        return (1 + self.second) * sum(self.orders[:k]) + k

    def z(self, k: int = 0) -> slice:
        """Z of a channel."""
        return slice(self._first(k), self._first(k) + self.orders[k])

    def states(self, k: int = 0) -> slice:
        """Z and w of a channel."""
        return slice(self._first(k), self.u(k))

    def u(self, k: int = 0) -> int:
        """The input of a channel."""
        return self._first(k + 1) - 1

    @property
    def y(self) -> int:
        """The output."""
        return self._first(len(self.orders))

    def free_z(self, block: int = 0) -> slice:
        """Z of a free response."""
        first = self.free_states(block).start
        return slice(first, first + self.free[block])

    def free_states(self, block: int = 0) -> slice:
        """Z and w of a free response."""
        first = self.y + 1 + (1 + self.second) * sum(self.free[:block])
        return slice(first, first + (1 + self.second) * self.free[block])

    @property
    def powers(self) -> slice:
        """Powers of the time since the first instant."""
        return slice(self.size - len(self.trend), self.size)

    @property
    def size(self) -> int:
        """Number of columns."""
        return self.y + 1 + (1 + self.second) * sum(self.free) + len(self.trend)


def rows_of(
    forms: Sequence[Fractions | Chain],
    columns: Columns,
    delays: Delays,
    data: FilterData | FrequencyLines,
    period: float,
    noise: SampledNoise | None = None,
    channels: tuple[Channel, ...] = SINGLE,
) -> Iterator[Array]:
    """Yield the rows of the used samples, transposed, piece by piece; whitened where a noise is given.

    There is a form for each channel.
    """
    if isinstance(data, FrequencyLines):
        answers = forms[0].at_lines(data, each_delay(delays)[0].place(data.interval), columns.second > 0)
        yield data.parts(np.column_stack((answers, data.response)))
        return
    whitener = None if noise is None else Whitener(noise.noise, columns.size)
    second, done, each, inputs = columns.second, 0, each_delay(delays), data.inputs
    elapsed = data.t[data.use] if columns.free or any(columns.trend) else data.t
    forced = [
        form.forced(_record(each[channel.input], inputs[channel.input], period), second)
        for form, channel in zip(forms, channels, strict=True)
    ]
    free = [forms[[channel.block for channel in channels].index(block)] for block in range(len(columns.free))]
    for parts in zip(*forced, strict=True):
        count = len(parts[0])
        if not count:
            # A piece without outputs.
            continue
        rows = np.empty((columns.size, count))
        for k, part in enumerate(parts):
            rows[columns.states(k).start : columns.u(k) + 1] = part.T[:-1]
        rows[columns.y] = parts[0][:, -1]
        for block, form in enumerate(free):
            rows[columns.free_states(block)] = form.free(elapsed[done : done + count] - elapsed[0], second)
        for row, power in zip(rows[columns.powers], columns.trend, strict=True):
            row[:] = (elapsed[done : done + count] - data.t[0]) ** power if power else 1.0
        if noise is not None and whitener is not None:
            whitener(rows, noise.steps[done : done + count])
        done += count
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
    forms: Sequence[Form],
    columns: Columns,
    delays: Delays,
    data: FilterData | FrequencyLines,
    period: float,
    noise: SampledNoise | None = None,
    channels: tuple[Channel, ...] = SINGLE,
) -> Array:
    """Return a triangle with the second moments of the rows of all used samples."""
    # Memory is that of one piece, however long the record.
    triangle: Array | None = None
    for rows in rows_of(forms, columns, delays, data, period, noise, channels):
        triangle = _reduced(triangle, rows)
    assert triangle is not None
    return triangle


def triangles_of(
    forms: list[Modal],
    columns: Columns,
    delays: Delays,
    data: FilterData | FrequencyLines,
    period: float,
    noise: SampledNoise | None = None,
    channels: tuple[Channel, ...] = SINGLE,
) -> Array:
    """Return the triangles of several forms of one block without w, from one pass of all their modes: (K, q, q)."""
    poles, places = np.unique(np.concatenate([form.modes.poles for form in forms]), return_inverse=True)
    widths = np.where(poles.imag > 0.0, 2, 1)
    last = np.cumsum(widths)
    # Of each form the rows among those of all modes.
    each = [np.arange(last[place] - widths[place], last[place]) for place in places]
    z = np.concatenate(each).reshape(len(forms), columns.orders[0])
    whole = Columns.of((int(last[-1]),), False, bool(columns.free), columns.trend, channels)
    everywhere = np.tile(np.arange(whole.size), (len(forms), 1))
    chosen = [np.hstack((whole.z(k).start + z, everywhere[:, whole.u(k), None])) for k in range(len(channels))]
    chosen += [everywhere[:, whole.y, None]]
    chosen += [whole.free_z().start + z] if columns.free else []
    rows_of_forms = np.hstack([*chosen, everywhere[:, whole.powers]])
    triangles: list[Array | None] = [None] * len(forms)
    shared = [Fractions(Fractions.modes_of(poles))] * len(channels)
    for rows in rows_of(shared, whole, delays, data, period, noise, channels):
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
