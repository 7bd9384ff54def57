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
from ctid_cli.filtering.exponential import exponential_minus_identity, held_readout, held_step, place
from ctid_cli.filtering.filter_data import FilterData, clock_slack, split_delay
from ctid_cli.filtering.row_sink import BLOCK


class Delay(NamedTuple):
    """A delay, and on a regular clock the cell between two samples that it is read in, -1 for that of the delay."""

    seconds: float
    cell: int


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
def _states_at_breaks(dynamics: Array, gain: Array, data: FilterData, period: float, table: Transitions) -> Array:
    """States at every break of the input: from rest, or those of the input repeated for ever, shape (M, n)."""
    n, breaks = gain.size, data.tu.size
    u, tu = data.u, data.tu
    regular = data.interval > 0.0
    states = np.zeros((breaks + 1, n))
    step = held_step(dynamics, gain, data.interval)
    full, work = np.zeros(n + 2), np.zeros((2, n + 2))
    # Twice for a periodic input: once from rest to the end of the period, where x_N is left over, and once more from
    # x0 = x_N + Phi^N x0. With X = Phi^N - I, which the exponential gives without cancellation, X x0 = -x_N.
    for turn in range(2 if period > 0.0 else 1):
        if turn == 1:
            missing = exponential_minus_identity(dynamics * period)
            states[0] = np.linalg.solve(missing, -states[breaks])
        for j in range(breaks if period > 0.0 else breaks - 1):
            last = j == breaks - 1
            change = (u[0] if last else u[j + 1]) - u[j] if data.input_foh else 0.0
            if regular:
                for i in range(n):
                    states[j + 1, i] = step.from_value[i] * u[j] + step.from_change[i] * change
                _advance(step.transition, states[j], states[j + 1])
            else:
                length = (tu[0] + period if last else tu[j + 1]) - tu[j]
                for i in range(n):
                    full[i] = states[j, i]
                full[n], full[n + 1] = u[j], change / length
                irregular_step(table, length, full, work)
                for i in range(n):
                    states[j + 1, i] = full[i]
    return states


@njit(cache=True, nogil=True)
def _free_states(chain: ChainState, data: FilterData) -> Array:
    """States at the used samples of a chain left alone from the first of them on, shape (count, n)."""
    n = chain.free_start.size
    states = np.zeros((np.count_nonzero(data.use) if n else 0, n))
    if n == 0:
        return states
    step = held_step(chain.free_dynamics, chain.free_start, data.interval)
    regular = data.interval > 0.0
    table = _table(chain.free_dynamics, np.zeros(n), data, 0.0, 0.0)
    # The two states behind the n are an input and its slope, which stay zero: z(t) = exp(F (t - t_s)) z(t_s).
    now, following, work = np.zeros(n + 2), np.zeros(n + 2), np.zeros((2, n + 2))
    row = 0
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
            for i in range(n):
                states[row, i] = now[i]
            row += 1
    return states


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
def _read(rows: Array, readout: Array, result: Array) -> None:
    """Write rows of a block, or of the triangle, with the read-out in the place of what it is read from."""
    n = readout.shape[1] - 1
    result[:, : n + 1] = np.ascontiguousarray(rows[:, : n + 2]) @ readout
    result[:, n + 1 :] = rows[:, n + 2 :]


@njit(cache=True, nogil=True)
def rows_of(chain: ChainState, delay: Delay, data: FilterData, period: float, whole: bool) -> Array:
    """Rows ``[z, u, free response, 1, y]`` that have the second moments of those of all used samples, or these.

    On a regular clock z is left at the break before the instant that is read: the way from there is one map for all
    rows. On any other it is read at ``t - tau`` itself.
    """
    n, free = chain.gain.size, chain.free_start.size
    q = n + free + 4
    triangle, block = np.zeros((q, q)), np.zeros((q, BLOCK))
    every = np.zeros((np.count_nonzero(data.use) if whole else q, q - 1))
    readout = _readout(chain, delay, data.interval)
    tu, u, breaks = data.tu, data.u, data.tu.size
    alone = _free_states(chain, data)
    regular = data.interval > 0.0
    shift, slack = 0, 0.0
    if regular:
        shift = place_of(delay, data.interval)[0]
    else:
        slack = clock_slack(data)
    table = _table(chain.dynamics, chain.gain, data, delay.seconds, period)
    # The states at the breaks do not depend on the delay: it only chooses where they are read.
    states = _states_at_breaks(chain.dynamics, chain.gain, data, period, table)
    now, work = np.zeros(n + 2), np.zeros((2, n + 2))
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
        # The input that is held there, and its change up to the next break, after the last one that of the first.
        value, change, length = 0.0, 0.0, 1.0
        if j >= 0:
            value = u[j]
            if data.input_foh and j + 1 < breaks:
                change, length = u[j + 1] - value, tu[j + 1] - tu[j]
            elif data.input_foh and period > 0.0:
                change, length = u[0] - value, tu[0] + period - tu[j]
        for i in range(n):
            now[i] = states[j, i] if j >= 0 else 0.0
        now[n], now[n + 1] = value, change / length
        # On from the break to the instant itself, after which no change is left to be read.
        if not regular:
            irregular_step(table, rest, now, work)
            change = 0.0
        for i in range(n + 1):
            block[i, filled] = now[i]
        block[n + 1, filled] = change
        for i in range(free):
            block[n + 2 + i, filled] = alone[row, i]
        block[q - 2, filled], block[q - 1, filled] = 1.0, data.y[k]
        row += 1
        filled += 1
        if filled == BLOCK or row == every.shape[0] * whole:
            if whole:
                _read(np.ascontiguousarray(block[:, :filled].T), readout, every[row - filled : row])
            else:
                # R <- qr[R; block]: memory is that of one block, however long the record.
                absorb(triangle, block, filled)
            filled = 0
    if not whole:
        absorb(triangle, block, filled)
        _read(triangle, readout, every)
    return every
