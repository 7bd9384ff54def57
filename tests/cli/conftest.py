"""A tiny experiment, and a command line that runs inside the test."""

import pytest
from typer.testing import CliRunner

from ctid_cli.cli import _compiling
from ctid_cli.running import engine
from ctid_cli.running.job import Begun, run_job
from ctid_cli.running.workers import Ending

TINY = """\
experiment: tiny
system:      {numerator: [2], denominator: [1, 2], delay: 0.35}
excitation:  {kind: prbs, stages: 6, clock_period: 0.2, amplitude: 1.0}
sampling:    {kind: regular, interval: 0.1, samples: 400}
noise:       {kind: white, snr_db: [10, 20]}
estimators:
  search:    {kind: td_srivc, poles: 1, zeros: 0, delay_bounds: [0, 2], svf_cutoff: 2.0}
  known:     {kind: srivc, poles: 1, zeros: 0, delay: 0.35, svf_cutoff: 2.0}
starts:      {initial_delay: [0.3, {uniform: [0.2, 0.5]}]}
monte_carlo: {runs: 2, seed: 1}
success:     {delay_relative_error: 0.2}
"""

MEASURED = """\
experiment: measured-tiny
data:        {file: record.csv, time: t, input: u, output: y, hold: zoh, offset: remove, estimation_samples: 200}
estimators:
  known:     {kind: srivc, poles: 1, zeros: 0, svf_cutoff: 2.0}
"""


@pytest.fixture(autouse=True)
def compiled_in_silence(monkeypatch):
    """Compiled functions may be cached or not: what a command says while it waits for them is no part of a test."""
    monkeypatch.setattr(_compiling, "SILENT", 3600.0)


def record_text(samples=300):
    """A first-order response to a square wave, exact for a zero-order hold."""
    lines, x = ["t,u,y"], 0.0
    for k in range(samples):
        u = 1.0 if (k // 15 + k // 40) % 2 else -1.0
        lines.append(f"{0.1 * k:.1f},{u:g},{x + 1.0:.9f}")
        x = 0.8187307530779818 * x + 0.18126924692201818 * u
    return "\n".join(lines) + "\n"


class Here:
    """Workers in this process: for tests of what is computed, not of how processes are treated."""

    count = 1

    def __init__(self, count, limits):
        pass

    def results(self, jobs, stopping):
        for job in jobs:
            yield job, Ending([entry for entry in run_job(job) if not isinstance(entry, Begun)])

    def close(self):
        pass


@pytest.fixture(scope="module")
def without_workers():
    """Runs compute in the process of the test."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(engine, "LocalWorkers", Here)
        yield


@pytest.fixture(scope="session")
def ctid():
    """Run a command: ``ctid("table", "1")``."""
    from ctid_cli.cli.main import app

    def call(*arguments, code=0):
        done = CliRunner().invoke(app, [str(argument) for argument in arguments])
        assert done.exit_code == code, f"exit code {done.exit_code}\n{done.stdout}\n{done.stderr}\n{done.exception!r}"
        assert "Traceback" not in done.output
        return done

    return call


@pytest.fixture
def tiny(tmp_path):
    """File of the tiny experiment."""
    file = tmp_path / "tiny.yaml"
    file.write_text(TINY, encoding="utf-8")
    return file


@pytest.fixture
def measured(tmp_path):
    """File of a measured experiment, with its record beside it."""
    (tmp_path / "record.csv").write_text(record_text(), encoding="utf-8")
    file = tmp_path / "measured.yaml"
    file.write_text(MEASURED, encoding="utf-8")
    return file


@pytest.fixture(scope="module")
def done(tmp_path_factory, ctid):
    """Results folder with the tiny and the measured experiment, run once."""
    folder = tmp_path_factory.mktemp("done")
    (folder / "tiny.yaml").write_text(TINY, encoding="utf-8")
    (folder / "measured.yaml").write_text(MEASURED, encoding="utf-8")
    (folder / "record.csv").write_text(record_text(), encoding="utf-8")
    files = folder / "tiny.yaml", folder / "measured.yaml"
    assert ctid("run", *files, "--jobs", 1, "--quiet", "--out", folder / "results").stdout == ""
    return folder / "results"
