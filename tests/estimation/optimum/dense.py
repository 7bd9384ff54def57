"""The projected squared error by another route: dense matrices, polynomials and a general simulation."""

import numpy as np
from scipy.linalg import expm

from ctid_cli.filtering.simulate import simulate
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal


def squared_error(*args, **options):
    """Sum of squares of the residual."""
    left = residual(*args, **options)
    return float(left @ left)


def residual(record, denominator, zeros, delay=0.0, free_response=False, offset=False, period=0.0):
    """What least squares of the record on ``s^k/A u(t - tau)``, the free responses and a constant leaves."""
    shared, own = columns_of(record, denominator, zeros, delay, free_response, offset, period)
    return left_over(np.hstack((shared, own)), record.y[record.valid])


def left_over(phi, y):
    """What the columns of a matrix do not explain."""
    phi = phi / np.linalg.norm(phi, axis=0)
    return y - phi @ np.linalg.lstsq(phi, y, rcond=1e-12)[0]


def columns_of(record, denominator, zeros, delay=0.0, free_response=False, offset=False, period=0.0):
    """Columns that records have in common, and those of this one alone."""
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
    # The last of so many periods that nothing of the start is left.
    slowest = np.abs(np.roots(denominator).real).min()
    shifts = period * np.arange(-int(np.ceil(40.0 / (slowest * period))), 1)
    breaks = (record.input.t + shifts[:, None]).ravel()
    repeated = HeldSignal(breaks, np.tile(record.input.values, shifts.size), record.input.hold)
    return simulate(model, repeated, record.t)
