"""Results files that are right, which faults are put into."""

from pathlib import Path

import pytest

from tests.faults.harness import Fuzzer

STORED = Path(__file__).parents[1] / "storage" / "stored"
TINY = """\
experiment: tiny
system:      {numerator: [2], denominator: [1, 2], delay: 0.35}
excitation:  {kind: prbs, stages: 6, clock_period: 0.2, amplitude: 1.0}
sampling:    {kind: regular, interval: 0.1, samples: 400}
noise:       {kind: white, snr_db: [10, 20]}
estimators:
  known:     {kind: svf, poles: 1, zeros: 0, delay: 0.35, svf_cutoff: 2.0}
monte_carlo: {runs: 2, seed: 1}
success:     {delay_relative_error: 0.2}
"""


@pytest.fixture(scope="session")
def sealed_images():
    """Sealed files of a system, of a sum of submodels and of a signal."""
    from tests.faults.fuzz import images

    return images()


@pytest.fixture(scope="session")
def fuzzer(sealed_images, tmp_path_factory):
    """Makes inputs and tries them; commands that compute are asked for one input in fifty."""
    return Fuzzer(tmp_path_factory.mktemp("fuzz"), sealed_images, TINY, commands_every=50)
