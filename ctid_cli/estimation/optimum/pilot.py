"""A part of long records on which searches find out where to start on the whole."""

from collections.abc import Sequence

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.estimation.optimum.projection import Problem
from ctid_cli.filtering.filter_data import FilterData

#: Records of more samples than this are long, and so many of them are a part.
LONG, PART = 100_000, 20_000


def part_of(problem: Problem, latest: float) -> Problem | None:
    """The liveliest part of each record, with a free response; None where the records are not long.

    The input of a part is known for delays up to ``latest`` [s].
    """
    parts = liveliest_parts(problem.records, latest)
    if parts is None or any(problem.periods):
        return None
    records = tuple(_cut(data, part, latest) for data, part in zip(problem.records, parts, strict=True))
    return problem._replace(records=records, free_response=True, periods=(0.0,) * len(records))


def liveliest_parts(records: Sequence[FilterData], latest: float) -> list[slice] | None:
    """Samples of each record around which the input moves and the output varies most; None where none is long."""
    if sum(data.t.size for data in records) <= LONG or not all(data.common_clock for data in records):
        return None
    # What comes before the latest delay tells nothing.
    sizes = [PART // len(records) + int(latest * data.t.size / (data.t[-1] - data.t[0])) for data in records]
    return [liveliest(data.u, data.y, size) for data, size in zip(records, sizes, strict=True)]


def liveliest(u: Array, y: Array, size: int) -> slice:
    """So many samples around which the input moves and the output varies most."""
    if y.size <= size:
        return slice(None)
    moves, spread = np.abs(np.diff(u, append=u[-1])), np.abs(y - y.mean())
    life = np.cumsum(moves / max(moves.mean(), 1e-300) + spread / max(spread.mean(), 1e-300))
    begins = np.arange(0, y.size - size + 1, size // 4)
    begin = int(begins[np.argmax(life[begins + size - 1] - life[begins])])
    return slice(begin, begin + size)


def _cut(data: FilterData, part: slice, latest: float) -> FilterData:
    """A part, whose samples do not count while the input is unknown."""
    if part == slice(None):
        return data
    t, y, u = (values[part].copy() for values in (data.t, data.y, data.u))
    return data._replace(t=t, y=y, use=data.use[part] & (t >= t[0] + latest), tu=t, u=u)
