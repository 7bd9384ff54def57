r"""The two-stage method for a loop whose controller is not known, as a check of instruments from the reference.

First the input is regressed on the reference,

.. math:: \hat u(t_k) = c + \sum_{i=0}^{L-1} f_i r(t_{k-i}),

then the plant is estimated from :math:`\hat u` and the output as in open loop: what noise moves of the input is not in
:math:`\hat u` (P. M. J. Van den Hof, R. J. P. Schrama, *An indirect method for transfer function estimation from closed
loop data*, Automatica 29(6), 1993, https://doi.org/10.1016/0005-1098(93)90015-L).
"""

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record

#: Lags that are tried, doubled from the first as long as this many samples stand for each.
FIRST_LAGS, SAMPLES_PER_LAG = 4, 10


def input_from_reference(reference: Array, u: Array) -> Array:
    """Return the part of an input that follows the reference; the number of lags is chosen by BIC.

    Before the record the reference is taken at its first value.
    """
    most = max(u.size // SAMPLES_PER_LAG, FIRST_LAGS)
    lengths = [FIRST_LAGS * 2**k for k in range(int(np.log2(most / FIRST_LAGS)) + 1)]
    padded = np.concatenate((np.full(lengths[-1] - 1, reference[0]), reference))
    lagged = np.lib.stride_tricks.sliding_window_view(padded, lengths[-1])[:, ::-1]
    best, least = u, np.inf
    for length in lengths:
        rows = np.column_stack((np.ones(u.size), lagged[:, :length]))
        # Rows that reach back before the record are predicted, not fitted; all candidates have the same ones.
        used = slice(min(lengths[-1], u.size // 2), None)
        weights = np.linalg.lstsq(rows[used], u[used])[0]
        left = u[used] - rows[used] @ weights
        criterion = left.size * np.log(left @ left + np.finfo(float).tiny) + (length + 1) * np.log(left.size)
        if criterion < least:
            best, least = rows @ weights, criterion
    return best


def without_feedback(record: Record) -> Record:
    """Return a record in a loop with the part of its input that follows the reference, as a record in open loop."""
    assert record.loop is not None
    u = input_from_reference(record.loop.reference, record.input.values)
    return Record(record.t, record.y, HeldSignal(record.t, u, record.input.hold), name=record.name)
