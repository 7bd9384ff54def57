"""What a recorder makes of an output."""

import numpy as np
import pytest

from ctid_cli.signals.recorder import Recorder
from ctid_cli.signals.streams import stream

OUTPUT = np.cumsum(stream(1, "noise", 0).standard_normal(50_000))


def test_rounded_values_are_on_the_grid_and_next_to_the_output():
    rounded = Recorder(resolution=0.3).rounded(OUTPUT)
    assert np.array_equal(rounded, 0.3 * np.rint(rounded / 0.3))
    errors = rounded - OUTPUT
    assert np.abs(errors).max() <= 0.15 * (1 + 1e-12)
    assert np.std(errors) == pytest.approx(0.3 / np.sqrt(12), rel=0.02)
    assert not np.signbit(Recorder(resolution=9.0).rounded(np.array([-0.1]))).any()
    assert Recorder().rounded(OUTPUT) is OUTPUT


@pytest.mark.parametrize("burst", [None, 20.0])
def test_losses_are_marked_and_nothing_else_changes(burst):
    recorder = Recorder(missing=0.2, mean_burst=burst)
    recorded = recorder.with_losses(OUTPUT, stream(1, "recorder", 0))
    lost = np.isnan(recorded)
    assert not lost[0]
    np.testing.assert_array_equal(recorded[~lost], OUTPUT[~lost])
    shares = np.array([stretch.mean() for stretch in np.array_split(lost, 100)])
    assert abs(lost.mean() - 0.2) < 4 * shares.std() / 10
    np.testing.assert_array_equal(np.isnan(recorder.with_losses(OUTPUT[:300], stream(1, "recorder", 0))), lost[:300])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"resolution": -1.0}, r"resolution must be zero or a positive number \[output unit\]"),
        ({"missing": 1.0}, "missing must be a share below 1"),
        ({"missing": 0.5, "mean_burst": 0.5}, r"mean_burst must be from 1 to 1e\+06 \[samples\]"),
    ],
)
def test_impossible_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        Recorder(**options)
