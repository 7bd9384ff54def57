"""Records and specifications as files for commands."""

from pathlib import Path

import numpy as np
import yaml
from scipy.signal import lfilter

from ctid_cli import HeldSignal, TransferFunction, simulate
from ctid_cli.custom_code import STUDIES
from ctid_cli.filtering.loop import simulate_loop
from ctid_cli.models.controller import DiscreteController

#: Command lines: their output, and their refusals.
COMMANDS = yaml.safe_load((Path(__file__).parent / "commands.yaml").read_text(encoding="utf-8"))
#: A controller, and the file that names it.
CONTROLLER = DiscreteController([0.8, -0.7], [1.0, -1.0])
LOOP = "loop:\n  controller: {numerator: [0.8, -0.7], denominator: [1.0, -1.0]}\n"
#: The system of most records.
SYSTEM = TransferFunction([3.0], [1.0, 1.2, 4.0], 0.73)

SPECIFICATIONS = {
    name: (Path(__file__).parent / "specifications" / f"{name}.yaml").read_text(encoding="utf-8")
    for name in ("tiny", "measured-tiny", "loop", "beat")
}
# The folder of the studies depends on the machine; their code may be run.
SPECIFICATIONS["beat"] = SPECIFICATIONS["beat"].replace("STUDIES", str(STUDIES))
TINY = SPECIFICATIONS["tiny"]


def rows(seed=0, n=500, noise=0.02, offset=0.0):
    """Return samples of t, u and y, shape (n, 3)."""
    rng = np.random.default_rng(seed)
    t = 0.1 * np.arange(n)
    u = np.repeat(rng.choice([-1.0, 1.0], n // 5), 5)
    y = simulate(SYSTEM, HeldSignal(t, u), t) + offset + noise * rng.standard_normal(n)
    return np.column_stack((t, u, y))


def tones(n=3000):
    """Return samples of t and of a signal of 12 and 19 Hz with noise, shape (n, 2)."""
    t = 0.002 * np.arange(n)
    y = 1.5 * np.sin(2 * np.pi * 12.0 * t) + np.sin(2 * np.pi * 19.0 * t + 1.0)
    return np.column_stack((t, y + 0.05 * np.random.default_rng(0).standard_normal(n)))


def first_order(n=300):
    """Return samples of the response of y' = -2 y + 2 u to a square wave, with noise, shape (n, 3)."""
    t, k = 0.1 * np.arange(n), np.arange(n)
    u = np.where((k // 15 + k // 40) % 2, 1.0, -1.0)
    y = 1.0 + simulate(TransferFunction([2.0], [1.0, 2.0]), HeldSignal(t, u), t)
    return np.column_stack((t, u, y + 0.02 * np.random.default_rng(0).standard_normal(n)))


def in_loop(file):
    """Write a record of 2/(p + 1.5) under the controller of LOOP with coloured noise: u, y, r, and noisy u as v."""
    rng = np.random.default_rng(4)
    t = 0.05 * np.arange(1500)
    r = np.repeat(rng.choice([-1.0, 1.0], 150), 10)
    noise = lfilter([0.05], [1.0, -0.95], np.r_[0.0, rng.standard_normal(1499)])
    found = simulate_loop(TransferFunction([2.0], [1.0, 1.5]), CONTROLLER, r, noise, 0.05)
    spoilt = found.u + 0.1 * rng.standard_normal(1500)
    return write(file, (t, found.u, found.x + noise, r, spoilt), "t,u [V],y [rpm],r [rpm],v [V]")


def write(file, values, header="t,u,y"):
    """Write a text file of rows, or of a tuple of columns."""
    if isinstance(values, tuple):
        values = np.column_stack(values)
    np.savetxt(file, values, "%.12g", ",", header=header, comments="")
    return file
