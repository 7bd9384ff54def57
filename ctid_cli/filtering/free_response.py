r"""Free responses of submodels: what initial conditions add to the output, and their sensitivities.

The free response of submodel i after the first sample is that of ``C_i / (p^l A_i)`` to an impulse,
``C_i = c_0 + … + c_(n+l-1) p^(n+l-1)``, hence

.. math:: \frac{\partial x}{\partial c_k} = \frac{p^k}{p^l A_i}\delta, \qquad
          \frac{\partial x}{\partial a_k} = -\frac{p^k C_i}{p^l A_i^2}\delta .
"""

from __future__ import annotations

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
    combined: list[Array] = []
    degrees = []
    place_theta, place_free = 0, 0
    for term in terms:
        if term.order:
            combined += [theta[place_theta : place_theta + term.poles], free[place_free : place_free + term.order]]
            degrees.append((term.poles, term.order - 1, term.integrators))
        place_theta += term.size
        place_free += term.order
    by_theta, by_free = np.zeros((elapsed.size, theta.size)), np.zeros((elapsed.size, free.size))
    if not degrees:
        return np.zeros(elapsed.size), by_theta, by_free
    modes = simple_modes(np.concatenate(combined), np.array(degrees, dtype=np.int64), False)
    if modes is None:
        return None
    singles: list[Array] = []
    doubles: list[Array] = []
    for pole in modes.poles:
        response = np.exp(pole * elapsed)
        parts = [response.real, response.imag] if pole.imag else [response.real]
        singles += parts
        doubles += [elapsed * part for part in parts]
    integrals = [elapsed**k / factorial(k) for k in range(modes.origin.size)]
    rows = np.column_stack(singles + doubles + integrals)
    derivatives = rows @ modes.instruments[:, : rows.shape[1]].T
    place, place_theta, place_free = 0, 0, 0
    for term in terms:
        if term.order:
            by_theta[:, place_theta : place_theta + term.poles] = derivatives[:, place : place + term.poles]
            place += term.poles
            by_free[:, place_free : place_free + term.order] = derivatives[:, place : place + term.order]
            place += term.order
        place_theta += term.size
        place_free += term.order
    return rows @ modes.output[0, : rows.shape[1]], by_theta, by_free
