r"""Which of several fits to the same samples the data ask for, whatever the colour of the noise.

Criteria that count parameters take residuals as independent. Coloured noise is made white first, by one autoregressive
model for all fits, so that their criteria remain comparable: with c(q) that model and e, psi the residuals and
sensitivities of a fit,

.. math:: V = \min_x \| c(q) (e - \psi x) \|^2

is the squared innovation of the fit by generalised least squares, one Gauss-Newton step from that by least squares.
"""

from collections.abc import Sequence

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.inference.noise_model import NoiseModel, fit_noise_model
from ctid_cli.inference.residuals import all_white

#: Directions of the sensitivities with less than this share of the greatest singular value are none.
RANK = 1e-9
#: Parts of each record that are left out in turn.
BLOCKS = 10
#: A block that gives a larger share of what is known of a direction has it for itself.
OWN = 0.9


def shared_noise(residuals: Sequence[Array]) -> NoiseModel:
    """Noise behind the residuals of the closest fit: white, unless they are seen not to be."""
    return fit_noise_model(residuals, max_order=0 if all_white(residuals) else None)


def squared_innovations(residuals: Sequence[Array], psi: Sequence[Array], noise: NoiseModel) -> float:
    """V of a fit; the first samples of each record, without those before them, are left out."""
    order = noise.order
    errors = np.concatenate([noise.innovations(e)[order:] for e in residuals])
    left = float(errors @ errors)
    if order and psi[0].shape[1]:
        columns = np.concatenate([np.column_stack([noise.innovations(c)[order:] for c in block.T]) for block in psi])
        along = _orthonormal(columns).T @ errors
        left -= float(along @ along)
    return left


def innovations_count(residuals: Sequence[Array], noise: NoiseModel) -> int:
    """Number of samples in V."""
    return sum(max(e.size - noise.order, 0) for e in residuals)


def cross_validated_errors(residuals: Sequence[Array], psi: Sequence[Array]) -> tuple[Array, ...]:
    """Output errors of each tenth of each record with the parameters of the fit to all the rest, linearised.

    Without block B, ``e_B + Q_B (I - Q_B'Q_B)^-1 Q_B' e_B``, Q an orthonormal basis of the sensitivities. Directions
    that hardly anything but the block itself determines, such as the state before it, are taken from it.
    """
    basis = _orthonormal(np.concatenate(psi))
    splits = np.cumsum([e.size for e in residuals])[:-1]
    found = []
    for e, q in zip(residuals, np.split(basis, splits), strict=True):
        parts = []
        for rows in np.array_split(np.arange(e.size), BLOCKS):
            own, directions = np.linalg.eigh(q[rows].T @ q[rows])
            told = q[rows] @ directions[:, own < OWN]
            parts.append(e[rows] + told @ ((told.T @ e[rows]) / (1.0 - own[own < OWN])))
        found.append(np.concatenate(parts))
    return tuple(found)


def _orthonormal(columns: Array) -> Array:
    """Basis of what the columns span."""
    length = np.linalg.norm(columns, axis=0)
    scaled = columns[:, length > 0] / length[length > 0]
    left, values, _ = np.linalg.svd(scaled, full_matrices=False)
    return np.asarray(left[:, values > RANK * values.max(initial=0.0)])
