"""Medians by selection are those of NumPy, to the last bit."""

import numpy as np

from ctid_cli.frequency.medians import TOGETHER, medians_of_columns, middle_of


def test_medians_are_those_of_numpy():
    rng = np.random.default_rng(0)
    for size in (*range(1, 40), 101, 102, 1000):
        for values in (rng.standard_normal(size), rng.integers(0, 4, size).astype(float), np.arange(size, 0.0, -1.0)):
            assert middle_of(values.copy()) == np.median(values)


def test_medians_of_columns():
    for shape in ((1, 5), (16, TOGETHER + 3), (33, 2 * TOGETHER)):
        table = np.random.default_rng(1).standard_normal(shape)
        assert medians_of_columns(table).tolist() == np.median(table, axis=0).tolist()
