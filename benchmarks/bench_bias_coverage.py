"""Bias, scatter and coverage of fits to simulated frequency responses, and to records with two inputs.

    python benchmarks/bench_bias_coverage.py --systems first second samples integrator --size 600 --records 300
    python benchmarks/bench_bias_coverage.py --systems common own --size 600 --records 300

All delays are searched. Every record is searched in the basin of the true model, the first one also globally. With
``--out FILE`` the estimates, standard errors and quantiles are added to a file, one line of JSON for each record.
"""

import argparse
import json
import time
from collections.abc import Callable

from _timing import cpu

import numpy as np

from ctid_cli import (
    DelayProfile,
    FrequencyData,
    FrequencyDomain,
    HeldSignal,
    InputModel,
    Prbs,
    Record,
    TransferFunction,
    simulate,
)
from ctid_cli.estimators.frequency_domain import FrequencyDomainFit, _values
from ctid_cli.estimators.measured_fit import MeasuredFit, fitted

#: Frequency responses: model, degrees, integrators and sampling interval; 0 for G(jw).
RESPONSES = {
    "first": (TransferFunction([2.0], [1.0, 1.0], 0.7), 1, 0, 0, 0.0),
    "second": (TransferFunction([2.0, 4.0], [1.0, 1.0, 4.0], 0.73), 2, 1, 0, 0.0),
    "samples": (TransferFunction([2.0, 4.0], [1.0, 1.0, 4.0], 0.73), 2, 1, 0, 0.2),
    "integrator": (TransferFunction([4.0], [1.0, 2.0, 0.0], 0.33), 1, 0, 1, 0.1),
}
#: Records with two inputs: the model of each, and the fitted structure.
TWO_INPUTS = {
    "common": (
        (TransferFunction([1.0, 2.0], [1.0, 1.2, 1.0], 0.73), TransferFunction([-1.5], [1.0, 1.2, 1.0], 1.26)),
        DelayProfile(2, 1, (0.0, 2.0), inputs=(InputModel("u2", zeros=0),)),
    ),
    "own": (
        (TransferFunction([2.0], [1.0, 1.2, 1.0], 0.73), TransferFunction([-1.5], [1.0, 0.6], 1.26)),
        DelayProfile(2, 0, (0.0, 2.0), inputs=(InputModel("u1", poles=2), InputModel("u2", poles=1))),
    ),
}
INTERVAL, SNR_DB = 0.1, 15.0

#: Function that makes the data of one record from its random numbers.
Maker = Callable[[np.random.Generator], FrequencyData | Record]


def response_of(name: str, count: int, unknown: bool) -> tuple[FrequencyDomain, Maker]:
    """Return exact values with noise whose standard error is three times as large at the highest line."""
    model, poles, zeros, integrators, interval = RESPONSES[name]
    highest = 0.98 * np.pi / interval if interval else 20.0
    w = np.linspace(highest / count, highest, count)
    options = FrequencyDomain(poles, zeros, integrators=integrators, delay_bounds=(model.delay, model.delay))
    blank = FrequencyData(w, np.ones(count, dtype=complex), interval=interval)
    measured = options.prepare(blank).laid_out
    parts = measured.outputs[0] - measured.errors_of(model).residuals[0]
    values = parts[:count] + 1j * parts[count:]
    shape = 1.0 + 2.0 * w / highest
    power = np.median(np.abs(values) ** 2) if integrators else np.mean(np.abs(values) ** 2)
    errors = np.sqrt(power / np.mean(shape**2)) * 10 ** (-SNR_DB / 20) * shape

    def make(rng: np.random.Generator) -> FrequencyData:
        parts = rng.standard_normal((2, count)) / np.sqrt(2.0)
        noisy = values + errors * (parts[0] + 1j * parts[1])
        return FrequencyData(w, noisy, None if unknown else errors, interval)

    return FrequencyDomain(poles, zeros, (0.0, 2.0), integrators=integrators), make


def two_inputs(name: str, count: int) -> tuple[DelayProfile, Maker]:
    """Return records with new binary sequences as inputs, and white noise."""
    models, options = TWO_INPUTS[name]
    t = INTERVAL * np.arange(count)

    def make(rng: np.random.Generator) -> Record:
        # Registers of different lengths: shifted copies of one sequence could be collinear.
        signals = [Prbs(stages, 3 * INTERVAL).generate(t, rng) for stages in (10, 11)]
        inputs = {f"u{k}": HeldSignal(t, signal.at(t)) for k, signal in enumerate(signals, 1)}
        each = zip(models, inputs.values(), strict=True)
        y = np.sum([simulate(model, signal, t) for model, signal in each], axis=0)
        return Record(t, y + y.std() * 10 ** (-SNR_DB / 20) * rng.standard_normal(count), inputs)

    return options, make


def near_truth(name: str, options: DelayProfile, measured: object) -> MeasuredFit:
    """Return the fit in the basin of the true model."""
    if name in RESPONSES:
        model, poles = RESPONSES[name][:2]
        found = fitted(measured, measured.local((model.denominator[: poles + 1], (model.delay,))), None)
        return FrequencyDomainFit(**_values(found), data=measured.source)._with_uncertainty("auto", 0)
    models = TWO_INPUTS[name][0]
    delays = tuple(model.delay for model in models)
    poles = models[0].denominator if options.common else np.concatenate([model.poles for model in models])
    return fitted(measured, measured.local((poles, delays)), None)._with_uncertainty("auto", 0)


def main() -> None:
    """Print a line for each system and parameter."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--systems", nargs="+", default=[*RESPONSES, *TWO_INPUTS], choices=[*RESPONSES, *TWO_INPUTS])
    parser.add_argument("--size", type=int, default=600, help="lines, or samples")
    parser.add_argument("--records", type=int, default=300)
    parser.add_argument("--searched", type=int, default=5)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--unknown", action="store_true", help="no standard errors of lines: errors from the residuals")
    parser.add_argument("--out", help="file to which records are added")
    given = parser.parse_args()
    for name in given.systems:
        if name in RESPONSES:
            true = RESPONSES[name][0]
            options, make = response_of(name, given.size, given.unknown)
            theta = {"delay": true.delay, **true.parameters}
        else:
            options, make = two_inputs(name, given.size)
            models = TWO_INPUTS[name][0]
            theta = {f"u{k}_{key}": value for k, m in enumerate(models, 1) for key, value in m.parameters.items()}
            theta |= {f"u{k}_delay": m.delay for k, m in enumerate(models, 1)} | models[0].parameters
        began, found, agree = time.process_time(), [], 0
        for k in range(given.records):
            prepared = options.prepare(make(np.random.default_rng((given.seed, k))))
            fit = near_truth(name, options, prepared.laid_out)
            if k < given.searched:
                searched, whole = cpu(prepared.fit)
                began += searched
                agree += abs(whole.cost / fit.cost - 1.0) < 1e-6
            free = fit.tangent.any(axis=1)
            names = [n for n, f in zip(fit.parameter_names, free, strict=True) if f]
            errors = np.sqrt(np.diag(fit.law.covariance))[free]
            found.append([fit.theta[free], errors, fit.law.quantiles()[free]])
            if given.out:
                with open(given.out, "a") as file:
                    row = {"system": name, "size": given.size, "seed": given.seed, "record": k}
                    values = {n: [float(v) for v in v3] for n, *v3 in zip(names, *found[-1], strict=True)}
                    file.write(json.dumps(row | values) + "\n")
        estimates, spread, reach = np.moveaxis(np.array(found), 1, 0)
        error = estimates - [theta[n] for n in names]
        scatter = error.std(axis=0, ddof=1)
        theory = np.sqrt(np.nanmean(spread**2, axis=0))
        inside = np.mean(np.abs(error) <= reach * spread, axis=0)
        seconds = (time.process_time() - began) / given.records
        searched = min(given.searched, given.records)
        print(f"{name}, {given.size}: {agree} of {searched} searches reach it, {seconds:.2f} CPU s a record")
        for j, parameter in enumerate(names):
            bias = error[:, j].mean() / scatter[j]
            certain = f"{bias:+.3f} sd ({bias * np.sqrt(given.records):+.1f} Monte Carlo errors)"
            ratio = f"{scatter[j] / theory[j]:.3f}, coverage {100 * inside[j]:.1f} %"
            print(f"  {parameter:8} bias {certain}, scatter over theory {ratio}", flush=True)


if __name__ == "__main__":
    main()
