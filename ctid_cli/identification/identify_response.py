"""Fit of a model to a measured frequency response, with diagnostics."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from ctid_cli.estimators.frequency_domain import MISFIT, FrequencyDomain, FrequencyDomainFit, FrequencyDomainSum
from ctid_cli.estimators.identification import Identification
from ctid_cli.estimators.reported_parameters import determined, free_directions, reported_parameters
from ctid_cli.identification.choice import Given
from ctid_cli.identification.choose_response import ResponseChoice, answer_of_lines, choose_response
from ctid_cli.identification.fit_warnings import LOW_FIT, MOST, of_conditioning, of_lost_poles, of_search
from ctid_cli.inference.criteria import DECISIVE, information_criteria, r_t_squared, young_information_criterion
from ctid_cli.inference.fit import Status
from ctid_cli.inference.response_test import ResponseTest
from ctid_cli.processors import one_thread
from ctid_cli.signals.frequency_data import FrequencyData
from ctid_cli.text import probability


@one_thread
def identify_frequency_response(
    data: FrequencyData, options: FrequencyDomain | FrequencyDomainSum | Given | None = None
) -> Identification:
    """Fit a model to a frequency response and assess it; its structure is chosen unless it is given.

    Parameters
    ----------
    data : FrequencyData
        The frequency response.
    options : FrequencyDomain, FrequencyDomainSum or Given, optional
        Structure of the model, or given parts of it; by default all are chosen, see
        :func:`~ctid_cli.identification.choose_response.choose_response`.

    Returns
    -------
    Identification
        The model with its diagnostics; it has no records and no tests of residuals over time.

    Raises
    ------
    DataError
        If the data cannot be used.
    OptionError
        If given options contradict each other, or do not apply to a frequency response.

    Examples
    --------
    >>> import numpy as np
    >>> from ctid_cli import FrequencyData, FrequencyDomain
    >>> w, rng = np.geomspace(0.1, 10.0, 100), np.random.default_rng(0)
    >>> noise = 0.02 * (rng.standard_normal(100) + 1j * rng.standard_normal(100))
    >>> data = FrequencyData(w, 2.0 / (1j * w + 1.0) + noise, np.full(100, 0.02 * np.sqrt(2.0)))
    >>> found = identify_frequency_response(data, FrequencyDomain(1, 0))
    >>> {item.name: round(item.estimate, 2) for item in found.estimates if item.status == "free"}
    {'b0': 2.01, 'a1': 1.01}
    """
    if options is None or isinstance(options, Given):
        choice = choose_response(data, options)
        return _identified(data, choice.options, choice)
    return _identified(data, options, None)


def _identified(
    data: FrequencyData, options: FrequencyDomain | FrequencyDomainSum, choice: ResponseChoice | None
) -> Identification:
    """Fit a model and assess it; ``choice``: how its structure was chosen."""
    prepared = options.prepare(data)
    minimum = prepared.minimum() if choice is None else choice.taken.fit
    law = minimum.uncertainty("auto")
    fit, found = determined(minimum._with_law(law), prepared.laid_out, options._inside(minimum, prepared.laid_out))
    assert isinstance(fit, FrequencyDomainFit)
    (residuals,), (values,) = fit.residuals, prepared.laid_out.outputs
    response, free = answer_of_lines(fit), free_directions(fit)[0]
    return Identification(
        options=options,
        fit=fit,
        answer=response,
        **reported_parameters(fit, law, response.seen, prepared.laid_out, found)._asdict(),
        tests=(),
        criteria=information_criteria(float(residuals @ residuals), fit.count, fit.theta.size - len(fit.known)),
        yic=young_information_criterion(residuals, values, fit.theta[free], law.covariance[np.ix_(free, free)]),
        r_t_squared=r_t_squared(residuals, values),
        warnings=tuple(f"{text}." for text in [*_of_structure(fit, options, choice), *_warnings(fit, response)][:MOST]),
        choices=() if choice is None else choice.sentences,
    )


def _of_structure(
    fit: FrequencyDomainFit, options: FrequencyDomain | FrequencyDomainSum, choice: ResponseChoice | None
) -> Iterator[str]:
    """Yield peaks that the chosen structure does not describe, and that a delay is missing if none was chosen."""
    if choice is None:
        yield from _of_delay(fit, options)
    elif choice.answer.seen:
        yield from choice.missed


def _of_delay(fit: FrequencyDomainFit, options: FrequencyDomain | FrequencyDomainSum) -> Iterator[str]:
    """Yield that a delay is missing, if the model misses lines that a delay fits."""
    known, most = options.delay_bounds
    missed = fit.misfit_p_value < MISFIT or not fit.white or fit.fit_percent < LOW_FIT
    if not missed or known < most or options.zeros >= options.order:
        return
    # A longer delay would turn the phase of all lines by more than a quarter turn.
    reach = float(f"{known + 0.5 * np.pi / fit.data.frequencies[fit.data.frequencies > 0.0].min():.2g}")
    searched = replace(options, delay_bounds=(0.0, reach)).prepare(fit.data).fit()
    sizes = fit.count * np.log(fit.cost), searched.count * np.log(searched.cost) + np.log(searched.count)
    if sizes[0] - sizes[1] > DECISIVE:
        fits = f"the fit is {searched.fit_percent:.1f} instead of {fit.fit_percent:.1f} %"
        yield f"The delay is taken as {known:g} {fit.data.units[0]}: with --delay 0:{reach:g} {fits}"


def _warnings(fit: FrequencyDomainFit, response: ResponseTest) -> Iterator[str]:
    """Yield warnings, the most important first."""
    if not response.seen:
        yield f"No model: the values do not differ from noise ({probability(response.p_value)})"
        return
    if fit.misfit_p_value < MISFIT:
        what = f"The residuals are {np.sqrt(fit.excess):.3g} times as large as the standard errors of the data say"
        hold = ", or the input is not constant between the samples (ctid frf --hold)" * (fit.data.interval > 0.0)
        missed = f"the model misses a part of the response{hold}, or the errors are too small"
        yield f"{what} ({probability(fit.misfit_p_value)}): {missed}"
    if not fit.white and not fit.data.correlated:
        yield (
            "The residuals of neighbouring lines are correlated: the model misses a part of the response, or the lines "
            "share samples"
        )
    if fit.fit_percent < LOW_FIT and fit.data.standard_error is None:
        yield f"The fit is {fit.fit_percent:.1f} % of the weighted values"
    yield from of_lost_poles(fit)
    yield from of_search(fit, fit.data.units[0])
    if fit.status in (Status.CONVERGED, Status.AT_BOUND, Status.DELAY_AT_BOUND):
        assert fit.law is not None
        yield from of_conditioning(fit, fit.law)
    if fit.law is not None and fit.law.short:
        freedom = f"{fit.law.degrees_of_freedom:.2g} degrees of freedom"
        yield f"The errors of the lines are so correlated that intervals are those of Student's t with {freedom}: rough"
