"""Draw the picture of the README: the cost of a delay, its local minima, and the two searches.

Run in a clone: ``python docs/delay_minima.py``. The record is the one that ``ctid init`` writes (simulated).
"""

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from ctid_cli import DelayProfile, Start, TdSrivc, read_record

ROOT = Path(__file__).resolve().parents[1]
LONGEST = 20  # s

mpl.rcParams.update({"svg.hashsalt": "ctid", "font.size": 9})
record = read_record(ROOT / "ctid_cli" / "templates" / "measured-example.csv", offset="remove")
scale = 100 / np.var(record.y)
found = DelayProfile(poles=1, zeros=0, delay_bounds=(0, LONGEST)).fit(record)

delays = np.linspace(0, LONGEST, 161)
costs = [scale * DelayProfile(poles=1, zeros=0, delay_bounds=(delay, delay)).fit(record).cost for delay in delays]
starts = np.arange(0, LONGEST + 1.0, 2.0)
ends = [TdSrivc(poles=1, zeros=0, delay_bounds=(0, LONGEST)).fit(record, Start(delay=start)) for start in starts]

figure = Figure(figsize=(7.2, 3.0), layout="constrained")
axes = figure.subplots()
axes.plot(delays, costs, color="0.35", lw=1.2, label="least cost at each delay")
for start, end in zip(starts, ends, strict=True):
    at = [start, end.parameters["delay"]]
    axes.plot(at, np.interp(at, delays, costs), ":", color="C1", lw=1)
    axes.plot(at[0], np.interp(at[0], delays, costs), "o", color="C1", mfc="white", ms=4)
    axes.plot(at[1], np.interp(at[1], delays, costs), "o", color="C1", ms=5)
axes.plot([], [], "o:", color="C1", ms=5, label="local searches (td_srivc), from open to filled circle")
axes.plot(found.parameters["delay"], scale * found.cost, "*", color="C0", ms=13, label="global search (delay_profile)")
axes.axvline(1.3, color="C2", lw=0.8, ls="--", label="true delay")
axes.set(
    xlabel="delay [s]", ylabel="mean squared error [% of the variance]", xlim=(-0.3, LONGEST + 0.3), ylim=(0, None)
)
axes.legend(loc="lower right", frameon=False)
figure.savefig(ROOT / "docs" / "delay-minima.svg", metadata={"Date": None})
