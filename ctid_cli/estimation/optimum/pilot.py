"""A part of long records on which searches find out where to start on the whole."""

import numpy as np

from ctid_cli.estimation.optimum.projection import Problem
from ctid_cli.filtering.filter_data import FilterData

#: Records of more samples than this are long, and so many of them are a part.
LONG, PART = 100_000, 20_000


def part_of(problem: Problem, latest: float) -> Problem | None:
    """The liveliest part of each record, with a free response; None where the records are not long.

    The input of a part is known for delays up to ``latest`` [s].
    """
    records = problem.records
    short = sum(data.t.size for data in records) <= LONG
    if short or any(problem.periods) or not all(data.common_clock for data in records):
        return None
    size = PART // len(records)
    parts = tuple(_liveliest(data, size, latest) for data in records)
    return problem._replace(records=parts, free_response=True, periods=(0.0,) * len(parts))


def _liveliest(data: FilterData, size: int, latest: float) -> FilterData:
    """So many samples around which the input moves and the output varies most, less those whose input is unknown."""
    if data.t.size <= size:
        return data
    moves, spread = np.abs(np.diff(data.u, append=data.u[-1])), np.abs(data.y - data.y.mean())
    life = np.cumsum(moves / max(moves.mean(), 1e-300) + spread / max(spread.mean(), 1e-300))
    begins = np.arange(0, data.t.size - size + 1, size // 4)
    begin = int(begins[np.argmax(life[begins + size - 1] - life[begins])])
    part = slice(begin, begin + size)
    t, y, u = (values[part].copy() for values in (data.t, data.y, data.u))
    return data._replace(t=t, y=y, use=data.use[part] & (t >= t[0] + latest), tu=t, u=u)
