"""An estimator around scipy.optimize.least_squares."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from ctid_cli import Estimator, TransferFunction, simulate


@dataclass(frozen=True)
class OutputError(Estimator):
    """Least output error of a first-order model with a delay.

    Parameters
    ----------
    greatest_delay : float
        The delay is sought up to this [s].
    """

    start_from = "delay"

    greatest_delay: float

    def fit(self, record, start):
        used = record.valid

        def error(theta):
            b0, a1, delay = theta
            x = simulate(TransferFunction([b0], [1.0, a1], delay), record.input, record.t)
            return x[used] - record.y[used]

        delay = 0.5 * self.greatest_delay if start is None else start.delay
        low, high = [-np.inf, 1e-3, 0.0], [np.inf, 1e3, self.greatest_delay]
        found = least_squares(error, [1.0, 1.0, delay], bounds=(low, high))
        variance = 2.0 * found.cost / (used.sum() - found.x.size)
        errors = np.sqrt(np.diag(variance * np.linalg.pinv(found.jac.T @ found.jac)))
        names = ("b0", "a1", "delay")
        return {
            "parameters": dict(zip(names, found.x, strict=True)),
            "standard_errors": dict(zip(names, errors, strict=True)),
            "status": "CONVERGED" if found.status > 0 else "MAX_ITERATIONS",
        }
