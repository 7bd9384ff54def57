"""Records and specifications as the files that commands read."""

import numpy as np

from ctid_cli import HeldSignal, TransferFunction, simulate
from ctid_cli.custom_code import STUDIES

#: The system of most records.
SYSTEM = TransferFunction([3.0], [1.0, 1.2, 4.0], 0.73)

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
data:        {file: measured.csv, time: t, input: u, output: y, hold: zoh, offset: remove, estimation_samples: 200}
estimators:
  known:     {kind: srivc, poles: 1, zeros: 0, svf_cutoff: 2.0}
"""

#: Submodels in a loop, with coloured noise and starts around the truth.
LOOP = """\
experiment: loop
system:
  additive:
    - {numerator: [1], denominator: [0.025, 0.01, 1]}
    - {numerator: [3], denominator: [0.25, 0.25, 1]}
loop:
  controller: {pid: {kp: 0.0115, ki: 0.00725, kd: 0.00454}}
  reference: {kind: gaussian, standard_deviation: 10.0}
sampling: {kind: regular, interval: 0.05, samples: {geometric: [300, 600, 2]}}
noise: {kind: arma, numerator: [1], denominator: [1, -0.5], variance: 0.01}
estimators:
  both: {kind: additive_srivc, terms: [{poles: 2, zeros: 0}, {poles: 2, zeros: 0}], instruments: closed_loop}
  one: {kind: srivc, poles: 4, zeros: 2, instruments: closed_loop}
starts: {parameters: [{relative_uniform: 0.01}, {relative_uniform: 0.02}]}
monte_carlo: {runs: 2, seed: 1}
success: {parameter_relative_error: 0.2}
"""

#: Frequencies of a signal, by two trackers and one estimator of the whole record.
BEAT = f"""\
experiment: beat
signal:
  tones: [{{frequency: [{{until: 8, value: 1.8}}, {{value: 2.2}}]}}, {{frequency: 3.0, phase: 1.5}}]
disturbance: {{kind: uniform, half_width: [0.001, 0.01]}}
sampling: {{kind: regular, interval: 0.02, duration: 20}}
estimators:
  restarting: {{kind: restarting_least_squares, tones: 2, h: [0.6, 0.7], prefilter: 0.5}}
  finite: {{kind: drem_finite_time, tones: 2, h: 0.7, d: 0.4, epsilon: 0.1, gamma: 1.0, initial_frequencies: [2, 4]}}
  whole: {{kind: "{STUDIES}/finite_time_frequency/comparators/whole_record.py:Esprit", tones: 2}}
success: {{band: 0.05, by: 8, window: [18, 20]}}
monte_carlo: {{runs: 3, seed: 1}}
"""

SPECIFICATIONS = {"tiny": TINY, "measured-tiny": MEASURED, "loop": LOOP, "beat": BEAT}


def rows(seed=0, n=500, noise=0.02, offset=0.0):
    """Samples of t, u and y, shape (n, 3)."""
    rng = np.random.default_rng(seed)
    t = 0.1 * np.arange(n)
    u = np.repeat(rng.choice([-1.0, 1.0], n // 5), 5)
    y = simulate(SYSTEM, HeldSignal(t, u), t) + offset + noise * rng.standard_normal(n)
    return np.column_stack((t, u, y))


def tones(n=3000):
    """Samples of t and of a signal of 12 and 19 Hz with noise, shape (n, 2)."""
    t = 0.002 * np.arange(n)
    y = 1.5 * np.sin(2 * np.pi * 12.0 * t) + np.sin(2 * np.pi * 19.0 * t + 1.0)
    return np.column_stack((t, y + 0.05 * np.random.default_rng(0).standard_normal(n)))


def first_order(n=300):
    """Samples of the response of y' = -2 y + 2 u to a square wave, with noise, shape (n, 3)."""
    t, k = 0.1 * np.arange(n), np.arange(n)
    u = np.where((k // 15 + k // 40) % 2, 1.0, -1.0)
    y = 1.0 + simulate(TransferFunction([2.0], [1.0, 2.0]), HeldSignal(t, u), t)
    return np.column_stack((t, u, y + 0.02 * np.random.default_rng(0).standard_normal(n)))


def write(file, values, header="t,u,y"):
    """A text file of rows, or of a tuple of columns."""
    if isinstance(values, tuple):
        values = np.column_stack(values)
    np.savetxt(file, values, "%.12g", ",", header=header, comments="")
    return file
