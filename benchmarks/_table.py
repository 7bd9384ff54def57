"""Table of a campaign: errors of each parameter in standard deviations by theory, and coverage of intervals."""

import numpy as np


def print_errors(names, errors, covered, **more):
    """Print bias with its Monte Carlo error, scatter, coverage [%], and further columns with a number per parameter."""
    print("parameter      bias  (+-)  scatter  coverage" + "".join(f"  {title}" for title in more))
    errors, shares = np.asarray(errors), 100 * np.mean(covered, axis=0)
    scatter = errors.std(axis=0, ddof=1)
    for k, name in enumerate(names):
        monte_carlo = scatter[k] / np.sqrt(len(errors))
        extra = "".join(f"  {values[k]:{len(title)}.2f}" for title, values in more.items())
        print(f"{name:10} {errors[:, k].mean():8.3f} {monte_carlo:5.3f} {scatter[k]:8.3f} {shares[k]:9.1f}{extra}")
