"""Butterworth low-pass filtering of a whole record, input and output alike."""

from dataclasses import dataclass

import numpy as np
from numba import njit

from ctid_cli.arrays import Array
from ctid_cli.errors import OptionError
from ctid_cli.filtering.simulate import simulate
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.checks import require_integer
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record


@dataclass(frozen=True)
class Lowpass:
    """Butterworth low-pass filter.

    Parameters
    ----------
    cutoff : float
        Frequency at which the gain is -3 dB [rad/s].
    order : int, default 2
        Order of the filter, 1 to 20.

    Raises
    ------
    ValueError
        If the cut-off frequency is not positive or the order is out of range.
    """

    cutoff: float
    order: int = 2

    def __post_init__(self) -> None:
        if not (np.isfinite(self.cutoff) and self.cutoff > 0):
            raise OptionError(
                "cutoff", f"the low-pass cut-off must be a positive frequency in rad/s, not {self.cutoff}"
            )
        require_integer("order", self.order, 1, 20, label="the low-pass order")

    @property
    def model(self) -> TransferFunction:
        """The analogue filter, unit gain at zero frequency."""
        angles = np.pi * (2 * np.arange(self.order) + 1 + self.order) / (2 * self.order)
        denominator = np.real(np.poly(np.exp(1j * angles)))
        return TransferFunction([self.cutoff**self.order], denominator * self.cutoff ** np.arange(self.order + 1))

    def apply(self, record: Record) -> Record:
        """Filter the input and the output of a record by the same operator, both from rest.

        Parameters
        ----------
        record : Record
            The record; it is not changed.

        Returns
        -------
        Record
            Filtered record, masked where the original is.

        Raises
        ------
        ValueError
            If the cut-off lies at or above half the sampling frequency of a regular clock.

        Notes
        -----
        On a common regular clock the samples pass through one discrete filter. That commutes with any filter of the
        held signal, so no error is made; only a linearly held input that begins with a jump keeps a transient. On any
        other clock the held signals pass through the analogue filter exactly, and the smooth results are taken as
        linear between the samples.
        """
        y = record.bridged_y
        if record.interval is not None and record.input_on_grid:
            if self.cutoff * record.interval >= np.pi:
                raise ValueError(
                    f"the low-pass cut-off {self.cutoff:g} rad/s is not below half the sampling frequency, "
                    f"{np.pi / record.interval:g} rad/s"
                )
            sections = self._sections(record.interval)
            filtered_u = HeldSignal(record.input.t, _behind(sections, record.input.values.copy()), record.input.hold)
            filtered_y = _behind(sections, y.copy())
        else:
            instants = np.union1d(record.t, record.input.t[record.input.t <= record.t[-1]])
            filtered_u = HeldSignal(instants, simulate(self.model, record.input, instants), "foh")
            filtered_y = simulate(self.model, HeldSignal(record.t, y, "foh"), record.t)
        return Record(record.t, np.where(record.valid, filtered_y, np.nan), filtered_u, name=record.name)

    def _sections(self, interval: float) -> Array:
        """The filter by bilinear transform with the cut-off in its place, in sections of second order, shape (k, 5).

        Each is ``(b0 + b1/q + b2/q^2)/(1 + a1/q + a2/q^2)`` with unit gain at zero frequency.
        """
        warped = np.tan(0.5 * self.cutoff * interval)
        # Pairs of poles at the angles from the imaginary axis, the most damped first; of odd orders a real one too.
        angles = np.pi * np.arange(2 * (self.order // 2) - 1, 0, -2) / (2 * self.order)
        sections = [np.array([warped, warped, 0.0, warped - 1.0, 0.0]) / (1.0 + warped)] * (self.order % 2)
        square = warped**2
        for damping in (2.0 * np.sin(angles) * warped).tolist():
            section = np.array([square, 2.0 * square, square, 2.0 * (square - 1.0), 1.0 - damping + square])
            sections.append(section / (1.0 + damping + square))
        return np.array(sections)


@njit(cache=True, nogil=True)
def _behind(sections: Array, x: Array) -> Array:
    """Samples behind sections of second order in a row, from rest, in their place."""
    states = np.zeros((sections.shape[0], 2))
    for k in range(x.size):
        value = x[k]
        for i in range(sections.shape[0]):
            # Transposed direct form: two numbers remember all that went before.
            out = sections[i, 0] * value + states[i, 0]
            states[i, 0] = sections[i, 1] * value - sections[i, 3] * out + states[i, 1]
            states[i, 1] = sections[i, 2] * value - sections[i, 4] * out
            value = out
        x[k] = value
    return x
