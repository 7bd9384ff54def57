"""Drawings of frequency responses: magnitude and phase over the frequency."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from ctid_cli.arrays import Array, ComplexArray
from ctid_cli.models.additive import AdditiveModel
from ctid_cli.reporting.figures.style import Drawing

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class Response:
    """One curve."""

    label: str
    #: Frequencies, in the unit of the figure, rising, shape (K,).
    frequencies: Array
    #: Response [output unit/input unit], shape (K,).
    values: ComplexArray
    style: Mapping[str, Any] = field(default_factory=dict)
    phase: bool = True


def response_svg(curves: Sequence[Response], title: str, unit: str, *, unwrap: bool = True) -> bytes:
    """Magnitude and phase of frequency responses."""

    def draw(figure: Figure) -> None:
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=[1.7, 1])
        for curve in curves:
            above.semilogx(curve.frequencies, 20 * np.log10(np.abs(curve.values)), label=curve.label, **curve.style)
            if curve.phase:
                below.semilogx(curve.frequencies, _phase(curve.values, unwrap), **curve.style)
        above.set_ylabel("magnitude [dB]")
        below.set_ylabel("phase [°]")
        below.set_xlabel(rf"frequency $\omega$ [{unit}]" if unit == "rad/s" else f"frequency [{unit}]")
        if not unwrap:
            below.set_ylim(-190, 190)
            below.set_yticks([-180, -90, 0, 90, 180])
        above.margins(x=0.0)
        figure.legend(loc="outside lower center", ncols=3, frameon=False)
        figure.suptitle(title)

    return Drawing(7.5, 5.2, draw).saved()


def _phase(values: ComplexArray, unwrap: bool) -> Array:
    """Phase in degrees; where it jumps from one end of the range to the other, the curve is interrupted."""
    angle = np.angle(values)
    if unwrap:
        return np.asarray(np.rad2deg(np.unwrap(angle)))
    angle[:-1][np.abs(np.diff(angle)) > np.pi] = np.nan
    return np.asarray(np.rad2deg(angle))


def dense_frequencies(model: AdditiveModel, lowest: float, highest: float) -> Array:
    """Frequencies that show every resonance of a model, however narrow."""
    distances = np.geomspace(1e-6, 0.1, 60)
    around = np.concatenate([1 - distances, [1.0], 1 + distances])
    near = [submodel.natural_frequency * around for submodel in model.submodels]
    every = np.concatenate([np.geomspace(lowest, highest, 600), *near])
    return np.unique(every[(every >= lowest) & (every <= highest)])
