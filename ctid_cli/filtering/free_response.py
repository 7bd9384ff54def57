r"""Free responses of submodels: what initial conditions add to the output, and their sensitivities.

The free response of submodel i after the first sample is that of ``C_i / (p^l A_i)`` to an impulse,
``C_i = c_0 + … + c_(n+l-1) p^(n+l-1)``, hence

.. math:: \frac{\partial x}{\partial c_k} = \frac{p^k}{p^l A_i}\delta, \qquad
          \frac{\partial x}{\partial a_k} = -\frac{p^k C_i}{p^l A_i^2}\delta .
"""

from collections.abc import Sequence
from math import factorial

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.filtering.submodel_map import simple_modes
from ctid_cli.models.additive import Term


def free_response_size(terms: Sequence[Term]) -> int:
    """Number of parameters of the free responses."""
    return sum(term.order for term in terms)


def free_response(
    theta: Array, free: Array, terms: Sequence[Term], elapsed: Array
) -> tuple[Array, Array, Array] | None:
    """Free response and its sensitivities."""
    # The parameters of the terms that have states, and where they stand in (theta, free).
    places: list[int] = []
    degrees = []
    first_theta, first_free = 0, theta.size
    for term in terms:
        if term.order:
            places += [*range(first_theta, first_theta + term.poles), *range(first_free, first_free + term.order)]
            degrees.append((term.poles, term.order - 1, term.integrators))
        first_theta += term.size
        first_free += term.order
    derivatives = np.zeros((elapsed.size, theta.size + free.size))
    by_theta, by_free = derivatives[:, : theta.size], derivatives[:, theta.size :]
    if not degrees:
        return np.zeros(elapsed.size), by_theta, by_free
    modes = simple_modes(np.concatenate((theta, free))[places], np.array(degrees, dtype=np.int64))
    if modes is None:
        return None
    singles: list[Array] = []
    for pole in modes.poles:
        response = np.exp(pole * elapsed)
        singles += [response.real, response.imag] if pole.imag else [response.real]
    integrals = [elapsed**k / factorial(k) for k in range(modes.origin.size)]
    rows = np.column_stack([*singles, *(elapsed * single for single in singles), *integrals])
    maps = modes.maps[:, : rows.shape[1]]
    derivatives[:, places] = rows @ maps[: len(places)].T
    return rows @ maps[-1], by_theta, by_free
