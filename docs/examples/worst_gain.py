"""A measure: the largest error of the frequency response of a model below a frequency."""

from dataclasses import dataclass

import numpy as np

from ctid_cli import Measure


@dataclass(frozen=True)
class WorstGain(Measure):
    """Largest error of the frequency response up to a frequency, relative to the gain there.

    Parameters
    ----------
    highest : float
        The error is sought up to this frequency [rad/s].
    """

    unit = "%"

    highest: float

    def value(self, fit, data):
        omega = np.linspace(0.0, self.highest, 200)
        true = data.true_model.frequency_response(omega)
        return 100.0 * np.max(np.abs(fit.model.frequency_response(omega) / true - 1.0))
