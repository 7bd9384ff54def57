"""Records as the files that commands read."""

import numpy as np

from ctid_cli import HeldSignal, TransferFunction, simulate

#: The system of most of them.
SYSTEM = TransferFunction([3.0], [1.0, 1.2, 4.0], 0.73)


def rows(seed=0, n=500, noise=0.02, offset=0.0):
    """Samples of t, u and y, shape (n, 3)."""
    rng = np.random.default_rng(seed)
    t = 0.1 * np.arange(n)
    u = np.repeat(rng.choice([-1.0, 1.0], n // 5), 5)
    y = simulate(SYSTEM, HeldSignal(t, u), t) + offset + noise * rng.standard_normal(n)
    return np.column_stack((t, u, y))


def write(file, values, header="t,u,y"):
    """A text file of rows, or of a tuple of columns."""
    if isinstance(values, tuple):
        values = np.column_stack(values)
    np.savetxt(file, values, "%.12g", ",", header=header, comments="")
    return file
