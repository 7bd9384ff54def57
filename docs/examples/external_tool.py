"""Stands for a program in any language: reads t,u,y as CSV, answers with a first-order model as JSON."""

import json
import sys

import numpy as np

t, u, y = np.loadtxt(sys.stdin, delimiter=",", skiprows=1, unpack=True)
rows = np.column_stack([y[:-1], u[:-1]])
(pole, gain), *_ = np.linalg.lstsq(rows, y[1:], rcond=None)
if not 0.0 < pole < 1.0:
    sys.exit(f"the pole of the sampled model, {pole:.4g}, has no continuous-time counterpart")
a1 = -np.log(pole) / (t[1] - t[0])
json.dump({"b0": gain * a1 / (1.0 - pole), "a1": a1}, sys.stdout)
