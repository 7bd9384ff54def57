r"""One pass over a record: the states at every used sample, reduced by orthogonal transformations to a triangle.

With Z the rows ``[z, u, change of u, free response, 1, y]`` of all used samples, ``Z = Q R``: whatever is asked of
linear maps of these rows (projections, residuals, sums of squares) is asked of the same maps of R. Second moments would
square the condition; this costs little more, so that one route serves the search and its end.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from ctid_cli.arrays import Array
from ctid_cli.filtering.chain_pass import _longest_step as longest_step
from ctid_cli.filtering.chain_pass import _step as irregular_step
from ctid_cli.filtering.chain_pass import _Transitions as Transitions
from ctid_cli.filtering.chain_pass import _transitions as transitions
from ctid_cli.filtering.exponential import HeldStep, exponential_minus_identity, held_readout, held_step, place
from ctid_cli.filtering.filter_data import FilterData, clock_slack, split_delay
from ctid_cli.filtering.row_sink import BLOCK

#: Breaks of which the states are kept at a time.
STRETCH = 512
#: A free response is over when its states are this fraction of their greatest.
NOTHING = 1e-30
#: No combinations of columns are wanted but the second moments of all.
MOMENTS = np.zeros((0, 0))


class Delay(NamedTuple):
    """A delay, and on a regular clock the cell between two samples that it is read in, -1 for that of the delay."""

    seconds: float
    cell: int


class Way(NamedTuple):
    """What leads a chain from break to break: one step on a regular clock, else transitions over any."""

    step: HeldStep
    table: Transitions


class ChainState(NamedTuple):
    """A chain driven by the input, and one that decays from a state at the first used sample (or is empty)."""

    dynamics: Array
    gain: Array
    free_dynamics: Array
    free_start: Array


@njit(cache=True, nogil=True)
def place_of(delay: Delay, interval: float) -> tuple[int, float]:
    """Breaks by which the read-out lags, and the fraction, 0 to 1, of an interval that is read beyond that break.

    At a sample a cell is closed on both sides: each has its own slope there.
    """
    if delay.cell < 0:
        return split_delay(delay.seconds, interval)
    return delay.cell + 1, min(max(delay.cell + 1 - delay.seconds / interval, 0.0), 1.0)


@njit(cache=True, nogil=True)
def _advance(transition: Array, z: Array, following: Array) -> None:
    """``following += transition z`` for a chain, whose transition is zero above the first superdiagonal."""
    for i in range(z.size):
        total = 0.0
        for m in range(min(i + 2, z.size)):
            total += transition[i, m] * z[m]
        following[i] += total


@njit(cache=True, nogil=True)
def _table(dynamics: Array, gain: Array, data: FilterData, delay: float, period: float) -> Transitions:
    """Transitions over any step of a pass, or next to nothing on a regular clock."""
    if data.interval > 0.0:
        return transitions(np.zeros((0, 0)), np.zeros(0), 0.0)
    return transitions(dynamics, gain, max(longest_step(data.t, data.tu, delay), period))


@njit(cache=True, nogil=True)
def _follow(states: Array, begin: int, end: int, way: Way, data: FilterData, period: float) -> None:
    """The states at the breaks up to ``end``, in rows, from that at break ``begin`` in the first one."""
    n = states.shape[1]
    u, tu, foh, regular = data.u, data.tu, data.input_foh, data.interval > 0.0
    transition, from_value, from_change = way.step
    table, full, work = way.table, np.zeros(n + 2), np.zeros((2, n + 2))
    for j in range(begin, end):
        z, following = states[j - begin], states[j - begin + 1]
        last = j == tu.size - 1
        change = (u[0] if last else u[j + 1]) - u[j] if foh else 0.0
        if regular:
            for i in range(n):
                following[i] = from_value[i] * u[j] + from_change[i] * change
            _advance(transition, z, following)
        else:
            length = (tu[0] + period if last else tu[j + 1]) - tu[j]
            for i in range(n):
                full[i] = z[i]
            full[n], full[n + 1] = u[j], change / length
            irregular_step(table, length, full, work)
            for i in range(n):
                following[i] = full[i]


@njit(cache=True, nogil=True)
def _first_state(dynamics: Array, way: Way, data: FilterData, period: float) -> Array:
    """State at the first break: rest, or that of the input repeated for ever.

    From rest to the end of a period x_N is left over: x0 = x_N + Phi^N x0. With X = Phi^N - I, which the exponential
    gives without cancellation, X x0 = -x_N.
    """
    breaks, states = data.tu.size, np.zeros((STRETCH + 1, dynamics.shape[0]))
    first: Array = states[0]
    if period == 0.0:
        return first
    for begin in range(0, breaks, STRETCH):
        end = min(begin + STRETCH, breaks)
        _follow(states, begin, end, way, data, period)
        first[:] = states[end - begin]
    return np.asarray(np.linalg.solve(exponential_minus_identity(dynamics * period), -first))


@njit(cache=True, nogil=True)
def _free_states(chain: ChainState, data: FilterData) -> Array:
    """States at the used samples of a chain left alone from the first of them on, until nothing is left of it."""
    n = chain.free_start.size
    states = np.zeros((np.count_nonzero(data.use) if n else 0, n))
    if n == 0:
        return states
    step = held_step(chain.free_dynamics, chain.free_start, data.interval)
    regular = data.interval > 0.0
    table = _table(chain.free_dynamics, np.zeros(n), data, 0.0, 0.0)
    # The two states behind the n are an input and its slope, which stay zero: z(t) = exp(F (t - t_s)) z(t_s).
    now, following, work = np.zeros(n + 2), np.zeros(n + 2), np.zeros((2, n + 2))
    row, greatest = 0, 0.0
    for k in range(data.t.size):
        # Before the first used sample nothing moves; after it unused samples are steps of the way too.
        if row > 0 and regular:
            following[:n] = 0.0
            _advance(step.transition, now[:n], following[:n])
            now, following = following, now
        elif row > 0:
            irregular_step(table, data.t[k] - data.t[k - 1], now, work)
        if data.use[k]:
            if row == 0:
                for i in range(n):
                    now[i] = chain.free_start[i]
            left = 0.0
            for i in range(n):
                states[row, i] = now[i]
                left = max(left, abs(now[i]))
            row += 1
            greatest = max(greatest, left)
            if left <= NOTHING * greatest:
                break
    return states[:row]


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def absorb(triangle: Array, block: Array, count: int) -> None:
    """Householder reflections that move the rows of a block, one in each column, into an upper triangle."""
    q = triangle.shape[0]
    for j in range(q):
        own = block[j]
        power = 0.0
        for k in range(count):
            power += own[k] * own[k]
        if power == 0.0:
            continue
        # The reflector is [head, own]: above the block only row j of the triangle is met, the others have zeros here.
        old = triangle[j, j]
        length = np.sqrt(old * old + power)
        new = -length if old > 0.0 else length
        head = old - new
        scale = 2.0 / (head * head + power)
        triangle[j, j] = new
        for i in range(j + 1, q):
            other = block[i]
            along = head * triangle[j, i]
            for k in range(count):
                along += own[k] * other[k]
            along *= scale
            triangle[j, i] -= along * head
            for k in range(count):
                other[k] -= along * own[k]


@njit(cache=True, nogil=True)
def _readout(chain: ChainState, delay: Delay, interval: float) -> Array:
    """``[z, u]`` at the instants read, from ``[z, u, change of u]`` at the breaks before them, transposed."""
    n = chain.gain.size
    readout = np.zeros((n + 1, n + 2))
    fraction = place_of(delay, interval)[1] if interval > 0.0 else 0.0
    place(readout, 0, 0, held_readout(chain.dynamics, chain.gain, interval, fraction))
    readout[n, n], readout[n, n + 1] = 1.0, fraction
    return np.ascontiguousarray(readout.T)


@njit(cache=True, nogil=True)
def _read(rows: Array, free: int, readout: Array, result: Array) -> None:
    """Write rows of a block, or of the triangle, with the read-out in the place of what it is read from."""
    n, behind = readout.shape[1] - 1, free + readout.shape[0]
    result[:, : n + 1] = np.ascontiguousarray(rows[:, free:behind]) @ readout
    result[:, n + 1 : n + 1 + free] = rows[:, :free]
    result[:, n + 1 + free :] = rows[:, behind:]


@njit(cache=True, nogil=True)
def _held_input(data: FilterData, j: int, period: float) -> tuple[float, float, float]:
    """The input from a break on, its change up to the next one, and how long that takes."""
    u, tu = data.u, data.tu
    if data.input_foh and j + 1 < tu.size:
        return u[j], u[j + 1] - u[j], tu[j + 1] - tu[j]
    if data.input_foh and period > 0.0:
        return u[j], u[0] - u[j], tu[0] + period - tu[j]
    return u[j], 0.0, 1.0


@njit(cache=True, nogil=True)
def rows_of(chain: ChainState, delay: Delay, data: FilterData, period: float, wanted: Array) -> Array:
    """Rows ``[z, u, free response, 1, y]`` that have the second moments of those of all used samples.

    Or, where combinations of these columns are wanted, in the columns of a matrix, those of every used sample. On a
    regular clock z is left at the break before the instant that is read: the way from there is one map for all rows.
    On any other it is read at ``t - tau`` itself.
    """
    n, free = chain.gain.size, chain.free_start.size
    q, whole = n + free + 4, wanted.size > 0
    triangle, block, read = np.zeros((q, q)), np.zeros((q, BLOCK)), np.zeros((BLOCK, q - 1))
    every = np.zeros((np.count_nonzero(data.use) if whole else 0, wanted.shape[1]))
    readout = _readout(chain, delay, data.interval)
    tu, breaks = data.tu, data.tu.size
    alone = _free_states(chain, data)
    regular = data.interval > 0.0
    shift, slack = 0, 0.0
    if regular:
        shift = place_of(delay, data.interval)[0]
    else:
        slack = clock_slack(data)
    table = _table(chain.dynamics, chain.gain, data, delay.seconds, period)
    now, work = np.zeros(n + 2), np.zeros((2, n + 2))
    way = Way(held_step(chain.dynamics, chain.gain, data.interval), table)
    # The states at the breaks do not depend on the delay: it only chooses where they are read.
    first = _first_state(chain.dynamics, way, data, period)
    states, begin, end = np.zeros((STRETCH + 1, n)), 0, 0
    states[0] = first
    filled, row, j = 0, 0, -1
    for k in range(data.t.size):
        if not data.use[k]:
            continue
        # The last break whose input has arrived; in a periodic record one of the period before, if need be.
        rest = 0.0
        if regular:
            j = k - shift
            if j < 0 and period > 0.0:
                j += breaks
        else:
            instant = data.t[k] - delay.seconds
            if period > 0.0 and instant + slack < tu[0]:
                instant += period
            # Instants rise but for one step back, out of the period before: from there the breaks begin anew.
            if j >= 0 and instant + slack < tu[j]:
                j = -1
            while j + 1 < breaks and tu[j + 1] <= instant + slack:
                j += 1
            rest = max(0.0, instant - tu[j]) if j >= 0 else 0.0
        # The state at that break, from a stretch of them; after the step back from the first one again.
        if j < begin:
            states[0] = first
            begin = end = 0
        while end < j:
            states[0] = states[end - begin]
            begin, end = end, min(end + STRETCH, breaks - 1)
            _follow(states, begin, end, way, data, period)
        # The input that is held there, and its change up to the next break, after the last one that of the first.
        value, change, length = _held_input(data, j, period) if j >= 0 else (0.0, 0.0, 1.0)
        for i in range(n):
            now[i] = states[j - begin, i] if j >= 0 else 0.0
        now[n], now[n + 1] = value, change / length
        # On from the break to the instant itself, after which no change is left to be read.
        if not regular:
            irregular_step(table, rest, now, work)
            change = 0.0
        # The free response goes first: once nothing is left of it, no reflection touches its columns any more.
        for i in range(free):
            block[i, filled] = alone[row, i] if row < alone.shape[0] else 0.0
        for i in range(n + 1):
            block[free + i, filled] = now[i]
        block[q - 3, filled] = change
        block[q - 2, filled], block[q - 1, filled] = 1.0, data.y[k]
        row += 1
        filled += 1
        if filled == BLOCK or row == every.shape[0] * whole:
            if whole:
                _read(np.ascontiguousarray(block[:, :filled].T), free, readout, read[:filled])
                every[row - filled : row] = read[:filled] @ wanted
            else:
                # R <- qr[R; block]: memory is that of one block, however long the record.
                absorb(triangle, block, filled)
            filled = 0
    if whole:
        return every
    absorb(triangle, block, filled)
    rows = np.zeros((q, q - 1))
    _read(triangle, free, readout, rows)
    return rows
