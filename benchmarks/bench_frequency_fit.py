"""Bias, scatter and coverage of fits to simulated frequency responses.

    python benchmarks/bench_frequency_fit.py --lines 600 --records 250

Systems of first and second order with a delay that is searched: G(jw), samples under a zero-order hold, an integrator.
All records are searched in the basin of the true model, the first of them globally too.
"""

import argparse
import time

import numpy as np

from ctid_cli import FrequencyData, FrequencyDomain, TransferFunction
from ctid_cli.estimators.frequency_domain import fit_of

#: Model, degrees, integrators and sampling interval; 0 is G(jw).
SYSTEMS = {
    "first": (TransferFunction([2.0], [1.0, 1.0], 0.7), 1, 0, 0, 0.0),
    "second": (TransferFunction([2.0, 4.0], [1.0, 1.0, 4.0], 0.73), 2, 1, 0, 0.0),
    "samples": (TransferFunction([2.0, 4.0], [1.0, 1.0, 4.0], 0.73), 2, 1, 0, 0.2),
    "integrator": (TransferFunction([4.0], [1.0, 2.0, 0.0], 0.33), 1, 0, 1, 0.1),
}
SNR_DB = 15.0


def data_of(name: str, count: int) -> tuple[FrequencyData, np.ndarray]:
    """Exact values, and the standard errors of the noise, which is three times as large at the highest line."""
    model, poles, zeros, integrators, interval = SYSTEMS[name]
    highest = 0.98 * np.pi / interval if interval else 20.0
    w = np.linspace(highest / count, highest, count)
    options = FrequencyDomain(poles, zeros, integrators=integrators, delay_bounds=(model.delay, model.delay))
    blank = FrequencyData(w, np.ones(count, dtype=complex), interval=interval)
    measured = options.prepare(blank).laid_out
    parts = measured.outputs[0] - measured.errors_of(model).residuals[0]
    values = parts[:count] + 1j * parts[count:]
    shape = 1.0 + 2.0 * w / highest
    power = np.median(np.abs(values) ** 2) if integrators else np.mean(np.abs(values) ** 2)
    level = np.sqrt(power / np.mean(shape**2)) * 10 ** (-SNR_DB / 20)
    return FrequencyData(w, values, interval=interval), level * shape


def main() -> None:
    """Print a line for each system and parameter."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--lines", type=int, default=600)
    parser.add_argument("--records", type=int, default=250)
    parser.add_argument("--searched", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--unknown", action="store_true", help="no standard errors: errors from the residuals")
    given = parser.parse_args()
    for name, (model, poles, zeros, integrators, interval) in SYSTEMS.items():
        exact, errors = data_of(name, given.lines)
        true = np.concatenate((model.denominator[1 : poles + 1], model.numerator, [model.delay]))
        options = FrequencyDomain(poles, zeros, (0.0, 2.0), integrators=integrators)
        began, found, agree, searched = time.perf_counter(), [], 0, 0
        for k in range(given.records):
            rng = np.random.default_rng((given.seed, k))
            parts = rng.standard_normal((2, given.lines)) / np.sqrt(2.0)
            known = None if given.unknown else errors
            values = exact.response + errors * (parts[0] + 1j * parts[1])
            prepared = options.prepare(FrequencyData(exact.frequencies, values, known, interval))
            measured = prepared.laid_out
            fit = fit_of(measured, measured.local((model.denominator[: poles + 1], model.delay)))
            if k < given.searched:
                searched += 1
                agree += abs(prepared.fit().cost / fit.cost - 1.0) < 1e-6
            free = fit.tangent.any(axis=1)
            errors_of = np.sqrt(np.diag(fit.law.covariance))[free]
            found.append(np.stack((fit.theta[free], errors_of, fit.law.quantiles()[free])))
        estimates, spread, reach = np.moveaxis(np.array(found), 1, 0)
        error = estimates - true
        scatter = error.std(axis=0, ddof=1)
        theory = np.sqrt(np.nanmean(spread**2, axis=0))
        inside = np.mean(np.abs(error) <= reach * spread, axis=0)
        seconds = (time.perf_counter() - began) / given.records
        print(f"{name}: {agree} of {searched} searches reach it, {seconds:.2f} s a record")
        names = [n for n, f in zip(fit.parameter_names, free, strict=True) if f]
        for j, parameter in enumerate(names):
            bias = error[:, j].mean() / scatter[j]
            certain = f"{bias:+.3f} sd ({bias * np.sqrt(given.records):+.1f} Monte Carlo errors)"
            ratio = f"{scatter[j] / theory[j]:.3f}, coverage {100 * inside[j]:.1f} %"
            print(f"  {parameter:6} bias {certain}, scatter over theory {ratio}")


if __name__ == "__main__":
    main()
