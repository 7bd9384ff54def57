r"""How far intervals of a linearised estimate can be trusted, from what the linearisation leaves out.

An interval reaches q standard errors to each side. At its end the most likely other parameters are
``theta + d``, ``d = q C e_k / s_k``, and the output is ``x(theta + d)``. Of the part that the linearisation does not
have, ``x(theta + d) - x(theta) - Psi d``, the estimate would take

.. math:: M^{-1} \sum_t \psi_t \left( x_t(\theta + d) - x_t(\theta) - \psi_t' d \right),

which moves the end of the interval of parameter k; in half-widths of it, a curvature in the sense of [1]_.

References
----------
.. [1] D. M. Bates and D. G. Watts, *Nonlinear Regression Analysis and Its Applications*, Wiley, 1988, chapter 7.
"""

from collections.abc import Sequence

import numpy as np

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.errors import DataError
from ctid_cli.inference.parametric import Parametric
from ctid_cli.inference.uncertainty import Uncertainty
from ctid_cli.signals.record import Record

#: Intervals whose ends would move by more than this share of their half-width are unsafe. Measured medians, records of
#: 600 samples after a step: .05 to .2 where intervals cover 97 %, .35 at 98 %, 1.2 at 90 %, 1e5 at 74 %.
UNSAFE = 0.5


def shifts_of_ends(
    model: Parametric, law: Uncertainty, records: Sequence[Record], used: Sequence[BoolArray], psi: Sequence[Array]
) -> Array:
    """By how much either end of each parameter's interval would move, in half-widths; NaN of held ones, shape (p,).

    Infinite where a model at an end has no finite output.
    """
    covariance, reach = law.covariance, law.quantiles()
    found = np.full(len(covariance), np.nan)
    with np.errstate(invalid="ignore"):
        errors = np.sqrt(np.diag(covariance))
    mine = model.free[0]
    free = np.concatenate(psi) @ law.tangent
    here = [
        (model.simulated(r.input, r.t)[use], model.output_slopes(r.input, r.t)[use])
        for r, use in zip(records, used, strict=True)
    ]
    joint = np.nan_to_num(covariance)
    for k in mine[errors[mine] > 0]:
        change = reach[k] / errors[k] * joint[:, k]
        ends = []
        for step in (_within(model, change), _within(model, -change)):
            try:
                moved = model.at(step[mine])
                with np.errstate(all="ignore"):
                    left = [
                        moved.simulated(r.input, r.t)[use] - x - slopes @ step
                        for r, use, (x, slopes) in zip(records, used, here, strict=True)
                    ]
                    taken = law.tangent @ np.linalg.lstsq(free, np.concatenate(left))[0]
                ends.append(abs(float(taken[k])) / (reach[k] * errors[k]))
            except (DataError, np.linalg.LinAlgError):
                ends.append(np.inf)
        found[k] = np.nan_to_num(max(ends), nan=np.inf)
    return found


def _within(model: Parametric, step: Array) -> Array:
    """The step, as far as the delay stays above zero."""
    if "delay" not in model.names:
        return step
    last, delay = step[model.names.index("delay")], float(model.theta[-1])
    return step if delay + last >= 0.0 else step * (delay / -last)
