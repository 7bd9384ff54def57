"""The frequency of one tone from its zero crossings: half a period lies between two of them."""

from dataclasses import dataclass

import numpy as np

from ctid_cli import FrequencyEstimator, FrequencyTrack


@dataclass(frozen=True, kw_only=True)
class ZeroCrossings(FrequencyEstimator):
    """Mean frequency of a whole record.

    Parameters
    ----------
    tones : int
        Number of sinusoids, 1.
    """

    whole_record = True

    def track(self, samples, interval):
        y, k = np.asarray(samples), np.flatnonzero(np.diff(np.sign(samples)))
        t = interval * (k + y[k] / (y[k] - y[k + 1]))
        omega = np.pi * (t.size - 1) / (t[-1] - t[0])
        return FrequencyTrack(np.array([interval * (y.size - 1)]), np.array([[omega]]), np.zeros(1, np.uint16))
