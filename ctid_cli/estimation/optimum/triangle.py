r"""QR decomposition of the rows of all used samples of a record.

With Z the rows ``[z, w, u, y, free z, free w, 1, t - t_0]`` of all used samples (z, w and u of each of several inputs),
``Z = Q R``: projections, residuals and sums of squares of linear maps of these rows are those of the same maps of R.
Second moments would square the condition number; QR costs little more, so that it serves the search and its end.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import accumulate
from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array, IntArray
from ctid_cli.estimation.optimum.arrangement import Arrangement
from ctid_cli.estimation.optimum.chain import Chain, Form, Fractions, Modal, Record
from ctid_cli.filtering.bank import Place
from ctid_cli.filtering.filter_data import FilterData, split_delay
from ctid_cli.filtering.frequency_lines import FrequencyLines
from ctid_cli.inference.innovations import SampledNoise, Whitener


class Delay(NamedTuple):
    """Delay, and on a regular clock the index of its cell between two samples, -1 for the cell of the delay itself."""

    seconds: float
    cell: int

    def place(self, interval: float) -> Place:
        """Return the lag of the output in breaks, and the additional fraction, 0 to 1, of an interval.

        Cells include both end points, since the one-sided slopes at a sample differ. Without an interval, the delay.
        """
        if not interval:
            return self.seconds
        if self.cell < 0:
            return split_delay(self.seconds, interval)
        return self.cell + 1, min(max(self.cell + 1 - self.seconds / interval, 0.0), 1.0)


#: A delay, or one for each input.
Delays = Delay | tuple[Delay, ...]


def each_delay(delays: Delays) -> tuple[Delay, ...]:
    """Return the delay of each input."""
    return (delays,) if isinstance(delays, Delay) else delays


@dataclass(frozen=True)
class Columns:
    """Layout of the rows: z, w and u of each channel, y, z and w of each free response, powers of time."""

    #: Number of states, and input, of each channel.
    orders: tuple[int, ...]
    inputs: tuple[int, ...]
    #: Channels whose states have free responses.
    free: tuple[int, ...]
    #: Whether the rows contain w.
    second: bool
    trend: tuple[int, ...]

    @staticmethod
    @lru_cache(maxsize=1024)
    def of(arrangement: Arrangement, second: bool, free: bool, trend: tuple[int, ...]) -> "Columns":
        """Return the layout for the channels of a model, with or without w and free responses."""
        channels = arrangement.channels
        orders, inputs = (tuple(each) for each in zip(*((one.order, one.input) for one in channels), strict=True))
        return Columns(orders, inputs, arrangement.owners if free else (), second, trend)

    @cached_property
    def _first(self) -> list[int]:
        """First row of each channel, and the row of the output after them."""
        return list(accumulate(((1 + self.second) * order + 1 for order in self.orders), initial=0))

    @cached_property
    def _first_free(self) -> list[int]:
        """First row of each free response, and the first row after them."""
        widths = ((1 + self.second) * self.orders[k] for k in self.free)
        return list(accumulate(widths, initial=self.y + 1))

    def z(self, k: int = 0) -> slice:
        """Return the slice of z of a channel."""
        return slice(self._first[k], self._first[k] + self.orders[k])

    def states(self, k: int = 0) -> slice:
        """Return the slice of z and w of a channel."""
        return slice(self._first[k], self._first[k + 1] - 1)

    def u(self, k: int = 0) -> int:
        """Return the index of the input of a channel."""
        return self._first[k + 1] - 1

    @property
    def y(self) -> int:
        """Index of the output."""
        return self._first[-1]

    def free_states(self, place: int = 0) -> slice:
        """Return the slice of z and w of a free response."""
        return slice(self._first_free[place], self._first_free[place + 1])

    def free_z(self, place: int = 0) -> slice:
        """Return the slice of z of a free response."""
        first = self._first_free[place]
        return slice(first, first + self.orders[self.free[place]])

    @property
    def powers(self) -> slice:
        """Slice of the powers of the time since the first instant."""
        return slice(self._first_free[-1], self.size)

    @property
    def size(self) -> int:
        """Number of columns."""
        return self._first_free[-1] + len(self.trend)


def rows_of(
    forms: Sequence[Fractions | Chain],
    columns: Columns,
    delays: Delays,
    data: FilterData | FrequencyLines,
    period: float,
    noise: SampledNoise | None = None,
) -> Iterator[Array]:
    """Yield the rows of the used samples, transposed, piece by piece; whitened if a noise model is given.

    Each channel has one form.
    """
    each = each_delay(delays)
    if isinstance(data, FrequencyLines):
        model_response = forms[0].at_lines(data, each[0].place(data.interval), columns.second)
        yield data.parts(np.column_stack((model_response, data.response)))
        return
    whitener = None if noise is None else Whitener(noise.noise, columns.size)
    second, done, inputs = columns.second, 0, data.inputs
    elapsed = data.t[data.use] if columns.free or any(columns.trend) else data.t
    forced = [
        form.forced(_record(each[number], inputs[number], period), second)
        for form, number in zip(forms, columns.inputs, strict=True)
    ]
    for parts in zip(*forced, strict=True):
        count = len(parts[0])
        if not count:
            # A piece without outputs.
            continue
        rows = np.empty((columns.size, count))
        for k, part in enumerate(parts):
            # The output row follows the last input row.
            rows[columns.states(k).start : columns.u(k) + 2] = part.T
        for place, k in enumerate(columns.free):
            own = forms[k].free(elapsed[done : done + count] - elapsed[0], second)
            rows[columns.free_states(place)] = own
        for row, power in zip(rows[columns.powers], columns.trend, strict=True):
            row[:] = (elapsed[done : done + count] - data.t[0]) ** power if power else 1.0
        if noise is not None and whitener is not None:
            whitener(rows, noise.steps[done : done + count])
        done += count
        yield rows


def _reduced(triangle: Array | None, rows: Array) -> Array:
    """Return the triangle of rows, transposed and overwritten, appended to another triangle: R <- qr[R; rows]."""
    from scipy.linalg.lapack import dgeqrf  # slow to import

    q, whole = len(rows), rows if triangle is None else np.hstack((triangle.T, rows))
    # The transpose has LAPACK's memory order, so that nothing is copied, unlike in ``numpy.linalg.qr``.
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
) -> Array:
    """Return a triangle with the second moments of the rows of all used samples."""
    # Memory is limited to one piece for any length of the record.
    triangle: Array | None = None
    for rows in rows_of(forms, columns, delays, data, period, noise):
        triangle = _reduced(triangle, rows)
    assert triangle is not None
    return triangle


def triangles_of(
    candidates: Sequence[Sequence[Modal]],
    columns: Columns,
    delays: Delays,
    data: FilterData | FrequencyLines,
    period: float,
    noise: SampledNoise | None = None,
) -> Array:
    """Return the triangles of K models of one arrangement without w, from one pass of all modes: (K, q, q)."""
    shared, chosen, count = list[Fractions](), list[IntArray](), len(candidates)
    for forms in zip(*candidates, strict=True):
        poles, places = np.unique(np.concatenate([form.modes.poles for form in forms]), return_inverse=True)
        widths = np.where(poles.imag > 0.0, 2, 1)
        last = np.cumsum(widths)
        # Indices of the rows of each model among those of all modes.
        each = [np.arange(last[place] - widths[place], last[place]) for place in places]
        shared.append(Fractions(Fractions.modes_of(poles)))
        chosen.append(np.concatenate(each).reshape(count, -1) if each else np.zeros((count, 0), dtype=np.int64))
    whole = replace(columns, orders=tuple(int(np.where(one.modes.poles.imag > 0, 2, 1).sum()) for one in shared))
    everywhere = np.tile(np.arange(whole.size), (count, 1))
    wanted = [np.hstack((whole.z(k).start + z, everywhere[:, whole.u(k), None])) for k, z in enumerate(chosen)]
    wanted.append(everywhere[:, whole.y, None])
    wanted += [whole.free_z(place).start + chosen[k] for place, k in enumerate(columns.free)]
    rows_of_models = np.hstack([*wanted, everywhere[:, whole.powers]])
    triangles: list[Array | None] = [None] * count
    for rows in rows_of(shared, whole, delays, data, period, noise):
        triangles = [_reduced(*pair) for pair in zip(triangles, rows[rows_of_models], strict=True)]
    return np.array(triangles)


def _record(delay: Delay, data: FilterData, period: float) -> Record:
    """Return the record to be filtered; with a periodic input it begins one period before its samples."""
    if not period:
        return Record(data, delay.place(data.interval))
    place = delay.place(data.interval)
    if isinstance(place, tuple):
        shift, fraction = place
        # The last interval ends at the first break of the next period.
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
