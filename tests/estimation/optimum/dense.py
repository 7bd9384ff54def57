"""The projected squared error by a second method: dense matrices, polynomials and a general simulation."""

import numpy as np
from scipy.linalg import expm

from ctid_cli.filtering.simulate import simulate
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal


def squared_error(*args, **options):
    """Return the sum of squares of the residual."""
    left = residual(*args, **options)
    return float(left @ left)


def residual(record, denominator, zeros, delay=0.0, free_response=False, offset=False, period=0.0):
    """Return the residual of least squares of the record on ``s^k/A u(t - tau)``, free responses and a constant."""
    shared, own = columns_of(record, denominator, zeros, delay, free_response, offset, period)
    return left_over(np.hstack((shared, own)), record.y[record.valid])


def left_over(phi, y):
    """Return the residual of a projection on the columns of a matrix."""
    phi = phi / np.linalg.norm(phi, axis=0)
    return y - phi @ np.linalg.lstsq(phi, y, rcond=1e-12)[0]


def columns_of(record, denominator, zeros, delay=0.0, free_response=False, offset=False, period=0.0):
    """Return the columns common to all records, and those of this record only."""
    used = record.valid
    shared = [_response(record, np.eye(zeros + 1)[k], denominator, delay, period) for k in range(zeros + 1)]
    columns = []
    if free_response:
        A = np.diag(np.ones(denominator.size - 2), -1)
        A[0] = -denominator[1:]
        elapsed = record.t - record.t[used][0]
        columns += list(np.array([expm(A * time)[:, 0] for time in elapsed]).T)
    if offset:
        columns.append(np.ones(record.t.size))
    own = np.column_stack(columns) if columns else np.zeros((record.t.size, 0))
    return np.column_stack(shared)[used], own[used]


def _response(record, numerator, denominator, delay, period):
    model = TransferFunction(numerator, denominator, delay)
    if not period:
        return simulate(model, record.input, record.t)
    # The last of enough periods for the transient to vanish.
    slowest = np.abs(np.roots(denominator).real).min()
    shifts = period * np.arange(-int(np.ceil(40.0 / (slowest * period))), 1)
    breaks = (record.input.t + shifts[:, None]).ravel()
    repeated = HeldSignal(breaks, np.tile(record.input.values, shifts.size), record.input.hold)
    return simulate(model, repeated, record.t)
