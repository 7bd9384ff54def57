"""Common parts of the comparators: samples, options, and the certainty of an estimate of frequencies."""

import numpy as np

from ctid_cli import DataError

#: Frequencies are certain while the error that the misfit of the equations can cause is below this fraction of the
#: frequency itself and of the distance to its neighbours, as in ctid's own estimators.
CERTAIN_FRACTION = 0.1
#: An estimate over fewer periods, or beats of neighbours, than this is less certain than its misfit shows.
FIRST_PERIODS = 2.0
#: The remainder of a column of second moments that the others explain is rounding.
SINGULAR = 4e-16


def complete_samples(samples):
    """Return a copy of the samples; refuse missing ones."""
    y = np.array(samples, dtype=float)
    if y.ndim != 1 or not np.isfinite(y).all():
        raise DataError("the samples must be one series of finite numbers; this estimator takes no missing ones")
    return y


def require_positive(options, *names):
    """Refuse options that are zero or negative."""
    for name in names:
        value = getattr(options, name)
        if not value > 0.0:
            raise DataError(f"{name} must be a positive number, not {value!r}", name)


def is_certain(omega, error, span, elapsed, rounding=0.0):
    """Return whether rows of frequencies are certain, shape (N,).

    An error that the misfit can cause, shape (N, n), is compared with the frequency itself and with the distance to its
    neighbours. Within a part of a period, or of the beat of two neighbours, a bias or another tone is similar to a
    change of the frequencies and hardly visible as a misfit; measured errors grow like the fifth power of the missing
    part. The same holds for the first two periods, for any span [s] of the estimate. Rounding errors do not decrease
    with time, and are not enlarged at its beginning.
    """
    gaps = np.diff(omega, axis=1, prepend=0.0)
    room = np.minimum(gaps, np.pad(gaps[:, 1:], ((0, 0), (0, 1)), constant_values=np.inf))
    enough = np.reshape(np.minimum(span, elapsed / FIRST_PERIODS), (-1, 1))
    with np.errstate(all="ignore"):  # a NaN is not certain
        short = np.maximum(2.0 * np.pi / (room * enough), 1.0)
        return (error * short**5 + rounding <= CERTAIN_FRACTION * room).all(axis=1)


def scaled_inverses(moments):
    """Return scales, inverses of the matrices with unit diagonal, and whether these are non-singular.

    Parameters
    ----------
    moments : ndarray, shape (N, n, n)
        Second moments of regressors.
    """
    n = moments.shape[1]
    scales = np.sqrt(np.diagonal(moments, axis1=1, axis2=2))
    regular = np.isfinite(scales).all(axis=1) & (scales > 0.0).all(axis=1)
    scales = np.where(regular[:, None], scales, 1.0)
    unit = np.where(regular[:, None, None], moments / (scales[:, :, None] * scales[:, None, :]), np.eye(n))
    values, vectors = np.linalg.eigh(unit)
    regular &= values[:, 0] > SINGULAR * n
    values = np.where(regular[:, None], values, 1.0)
    return scales, vectors / values[:, None, :] @ vectors.swapaxes(1, 2), regular
