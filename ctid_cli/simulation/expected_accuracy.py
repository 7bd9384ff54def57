"""Theoretical accuracy of an estimator in a simulated experiment: covariance, its formula, and asymptotic bias."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ctid_cli.errors import BiasedError, DataError
from ctid_cli.inference.bounds import (
    EstimatedForm,
    ExpectedAccuracy,
    Instruments,
    accuracy_of_long_records,
    accuracy_of_records,
    require_uncorrelated_input,
)
from ctid_cli.models.additive import AdditiveModel, Submodel, Term, degrees_of
from ctid_cli.models.controller import ContinuousController, DiscreteController, Relay
from ctid_cli.models.factoring import factored, unfactored
from ctid_cli.models.several_inputs import MultiInputModel
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.excitation import Gaussian
from ctid_cli.signals.noise import Noise
from ctid_cli.signals.sampling import RegularSampling
from ctid_cli.simulation.components import CustomEstimation, is_custom
from ctid_cli.simulation.dataset import SimulatedSource

#: The asymptotic limit is used from this number of samples on.
LONG = 5000
#: Otherwise covariances are averaged over data sets: largest number of data sets, and of samples in all.
MOST_SETS, SET_SAMPLES = 10, 20_000
#: A known delay may differ from the true one by this fraction of it.
SAME_DELAY = 1e-6
#: A coefficient of partial fractions below this fraction of the others, or of its standard error, is rounding of zero.
ROUNDING = 1e-9


def expected_accuracy(
    source: SimulatedSource, estimator: Any, terms: tuple[Term, ...] | None = None
) -> ExpectedAccuracy:
    """Return the accuracy of an estimator on the data sets of a source."""
    estimated = _unbiased(source, estimator)
    if source.noise is None:
        raise DataError("the data have no noise, so nothing but rounding limits the accuracy")
    if source.loop is not None and isinstance(source.loop.controller, Relay):
        raise DataError("the relay feeds noise back into the input; the theory here covers linear controllers only")
    if source.loop is not None and isinstance(source.loop.controller, ContinuousController):
        raise DataError("the controller acts in continuous time; the theory here covers discrete controllers only")
    if (estimated.model.poles.real > 0.0).any():
        raise DataError("the system is unstable; the theory here covers stable systems only")
    why_not = _why_no_limit(source, estimated)
    accuracy = _of_records(source, estimated, why_not) if why_not else _of_long_records(source, estimated)
    if terms is None or not estimated.model.is_stable:
        return accuracy
    parameters = accuracy.parameters.factored(terms)
    # Partial fractions give rounding errors for coefficients whose true value is zero.
    rounding = np.abs(parameters.values) < ROUNDING * parameters.standard_errors
    return replace(accuracy, parameters=replace(parameters, values=np.where(rounding, 0.0, parameters.values)))


def why_biased(source: Any, estimator: Any) -> str:
    """Return why an estimator is asymptotically biased; empty if theory gives no reason."""
    if not isinstance(source, SimulatedSource):
        return ""
    try:
        _unbiased(source, estimator)
    except BiasedError as error:
        return str(error)
    except DataError:
        return ""
    return ""


def _unbiased(source: SimulatedSource, estimator: Any) -> EstimatedForm:
    """Return the system in the estimator's parametrisation, and raise a BiasedError if the estimator is biased."""
    system, loop, sampling, noise = source.system, source.loop, source.sampling, source.noise
    if isinstance(system, MultiInputModel):
        raise DataError("the theory here does not cover several inputs; compare with the scatter instead")
    if (
        not isinstance(system, TransferFunction | AdditiveModel)
        or isinstance(estimator, CustomEstimation)
        or is_custom(noise)
    ):
        raise DataError("the theory here does not cover custom systems, noises and estimators")
    estimated = _estimated(system, estimator)
    if loop is None or estimated.instruments != "open_loop" or noise is None:
        return estimated
    controller = loop.controller
    if isinstance(controller, ContinuousController):
        what = "the controller acts in continuous time, so that the input is correlated with the noise"
        raise BiasedError(f"{what} (closed_loop instruments are not)")
    if (
        isinstance(sampling, RegularSampling)
        and isinstance(noise, Noise)
        and isinstance(controller, DiscreteController)
    ):
        require_uncorrelated_input(system, sampling.mean_interval, controller, noise.filter)
    return estimated


def _estimated(system: AdditiveModel | TransferFunction, estimator: Any) -> EstimatedForm:
    """Return the system in the estimator's parametrisation, and raise an error if its model set lacks the system."""
    if estimator.kind == "svf":
        raise BiasedError("svf is a least-squares estimate, meant as the start of other estimators")
    bounds = getattr(estimator, "delay_bounds", None)
    low, high = bounds or (estimator.delay, estimator.delay)
    reach = 0.0 if bounds else SAME_DELAY * system.delay
    if not low - reach <= system.delay <= high + reach:
        sought = f"searched from {low:g} to {high:g} s" if bounds else f"fixed at {low:g} s"
        raise BiasedError(f"the delay is {sought}, but the true one is {system.delay:g} s")
    delay_from = high if low < high else None
    instruments: Instruments = getattr(estimator, "instruments", "open_loop")
    if hasattr(estimator, "terms"):
        return EstimatedForm(_in_terms(system, estimator.terms), None, delay_from, instruments)
    if estimator.zeros >= estimator.poles:
        raise DataError("the model has as many zeros as poles; the theory here covers strictly proper models only")
    fraction = unfactored(system) if isinstance(system, AdditiveModel) else system
    zeros = fraction.numerator.size - 1
    has = f"{estimator.poles} poles and {estimator.zeros} zeros, the system {fraction.order} and {zeros}"
    if estimator.poles < fraction.order or estimator.zeros < zeros:
        raise BiasedError(f"the model has {has}: it cannot represent the system")
    if estimator.poles > fraction.order:
        raise DataError(f"the model has {has}: no data determine the additional poles")
    weighed = getattr(estimator, "noise_model", "white") != "white"
    simulated = estimator.kind == "loop_output_error"
    return EstimatedForm(fraction, estimator.zeros, delay_from, instruments, weighed, simulated)


def _in_terms(system: AdditiveModel | TransferFunction, terms: tuple[Term, ...]) -> AdditiveModel:
    """Return the system as a sum of submodels with the degrees of an estimator's terms, by natural frequency."""
    if isinstance(system, AdditiveModel):
        submodels = list(system.submodels)
    else:
        submodels = [_without_rounding(submodel) for submodel in factored(system, terms).submodels]
    # In the given order if possible; otherwise the terms with the shortest numerators first.
    for order in (terms, sorted(terms, key=lambda term: term.zeros)):
        found = _matched(submodels, order)
        if found is not None:
            return AdditiveModel(found, system.delay).sorted()
    poles, needed = degrees_of(terms)[0], degrees_of([submodel.term() for submodel in submodels])[0]
    if poles < needed:
        raise BiasedError(f"the estimator's terms have {poles} poles, the system {needed}: they cannot represent it")
    numbers = f"the estimator's terms ({len(terms)}) do not match the submodels of the system ({len(submodels)})"
    raise DataError(f"{numbers}: they cannot represent it, or have additional parameters that no data determine")


def _matched(submodels: list[Submodel], terms: Sequence[Term]) -> list[Submodel] | None:
    """Return the submodels with numerators of the degrees of the terms; each takes the first term that fits."""
    left = list(terms)
    found = []
    for submodel in submodels:
        own = submodel.term()
        fitting = [t for t in left if (t.poles, t.integrators) == (own.poles, own.integrators) and t.zeros >= own.zeros]
        if not fitting:
            return None
        left.remove(fitting[0])
        found.append(replace(submodel, numerator=np.pad(submodel.numerator, (fitting[0].zeros - own.zeros, 0))))
    return None if left else found


def _without_rounding(submodel: Submodel) -> Submodel:
    """Return a submodel of partial fractions without leading coefficients that are rounding of zero."""
    sizes = np.abs(submodel.numerator) * submodel.natural_frequency ** np.arange(submodel.numerator.size)[::-1]
    numerator = np.trim_zeros(np.where(sizes > ROUNDING * sizes.max(), submodel.numerator, 0.0), "f")
    return Submodel(numerator, submodel.denominator, submodel.integrators)


def _why_no_limit(source: SimulatedSource, estimated: EstimatedForm) -> str:
    """Return why the asymptotic limit is not used, as a clause; empty if it is used."""
    sampling, (name, signal) = source.sampling, _driving(source)
    if estimated.delay_from is not None:
        return "the delay is estimated too"
    if not isinstance(sampling, RegularSampling):
        return "the clock is irregular"
    if estimated.weighed:
        return "the noise is estimated too"
    if estimated.simulated:
        return "the output error of a simulated loop is least"
    if not isinstance(signal, Gaussian) or signal.clock_period not in (None, sampling.interval):
        return f"the {name} is not white Gaussian noise held from sample to sample"
    if sampling.samples < LONG:
        return f"there are fewer than {LONG} samples"
    if not estimated.model.is_stable and (source.loop is None or isinstance(estimated.model, TransferFunction)):
        return "the system integrates, so that the information per sample grows with the record"
    return ""


def _driving(source: SimulatedSource) -> tuple[str, Any]:
    """Return the name of the driving signal and the signal."""
    return ("input", source.excitation) if source.loop is None else ("reference", source.loop.reference)


def _of_long_records(source: Any, estimated: EstimatedForm) -> ExpectedAccuracy:
    clock, loop, (_, signal) = source.sampling, source.loop, _driving(source)
    options = {} if loop is None else {"controller": loop.controller, "enters": loop.enters}
    deviation = signal.standard_deviation
    return accuracy_of_long_records(estimated, clock.interval, clock.samples, source.noise, deviation, **options)


def _of_records(source: Any, estimated: EstimatedForm, why_no_limit: str) -> ExpectedAccuracy:
    sets = max(1, min(MOST_SETS, SET_SAMPLES // source.sampling.length))
    records = [source.dataset(replicate).record for replicate in range(sets)]
    return accuracy_of_records(estimated, source.system, records, source.noise, why_no_limit)
