"""Butterworth low-pass filtering of input and output of a record."""

from dataclasses import dataclass

import numpy as np

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
        On a common regular clock the samples are filtered by one discrete filter. It commutes with any filter of the
        held signal, so that the result is exact; only a linearly held input that begins with a jump keeps a transient.
        On any other clock the held signals are filtered exactly by the analogue filter, and the smooth results are
        interpolated linearly between the samples.
        """
        from scipy.signal import butter, sosfilt

        y = record.bridged_y
        if record.interval is not None and record.input_on_grid:
            if self.cutoff * record.interval >= np.pi:
                raise ValueError(
                    f"the low-pass cut-off {self.cutoff:g} rad/s is not below half the sampling frequency, "
                    f"{np.pi / record.interval:g} rad/s"
                )
            # Bilinear transform with prewarping, which keeps the cut-off frequency.
            sections = butter(self.order, self.cutoff * record.interval / np.pi, output="sos")
            filtered_u = HeldSignal(record.input.t, sosfilt(sections, record.input.values), record.input.hold)
            filtered_y = sosfilt(sections, y)
        else:
            instants = np.union1d(record.t, record.input.t[record.input.t <= record.t[-1]])
            filtered_u = HeldSignal(instants, simulate(self.model, record.input, instants), "foh")
            filtered_y = simulate(self.model, HeldSignal(record.t, y, "foh"), record.t)
        return Record(record.t, np.where(record.valid, filtered_y, np.nan), filtered_u, name=record.name)
