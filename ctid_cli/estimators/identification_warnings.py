"""What the user should know before using a model that was fitted to measured records, in sentences."""

from collections.abc import Mapping, Sequence

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.estimators.delay_profile import MeasuredFit
from ctid_cli.estimators.measured_submodels import MeasuredSubmodels, Options
from ctid_cli.inference.covariance import condition_number, describe_conditioning
from ctid_cli.inference.fit import Status
from ctid_cli.inference.intervals import DelayInterval
from ctid_cli.inference.residual_tests import ResidualTests
from ctid_cli.inference.response_test import AnswerTest
from ctid_cli.inference.uncertainty import Uncertainty
from ctid_cli.text import listed


def of_answer(answer: AnswerTest, options: Options) -> list[str]:
    """That no answer to the input is seen, so that the model describes noise."""
    if answer.seen:
        return []
    low, high = options.delay_bounds
    return [
        f"No model: the output is not seen to answer to the input (p = {answer.p_value:.2g}). {answer.evidence} Check "
        f"the columns with ctid check, search other delays than {low:g}{f' to {high:g}' * (low < high)} (--delay), or "
        "record longer, with a stronger input."
    ]


def of_status(fit: MeasuredFit, *, said: bool = False) -> list[str]:
    """How the search ended, where it did not end well, and poles that are not in the table.

    A bound or a ridge need not be named where it has been said that a pole is too slow.
    """
    words = _of_lost_poles(fit.poles_at_infinity, fit.model.order)
    if fit.status is Status.DELAY_AT_BOUND and fit.model.delay == 0.0:
        return [
            *words,
            "The delay stopped at zero: this model needs none; take it as known (--delay 0), or use fewer poles.",
        ]
    if fit.status is Status.CONVERGED or (said and fit.status in (Status.AT_BOUND, Status.RIDGE)):
        return words
    return [*words, fit.status.value]


def _of_lost_poles(lost: int, left: int) -> list[str]:
    if not lost:
        return []
    what = "1 pole runs" if lost == 1 else f"{lost} poles run"
    return [f"{what} to infinity: more than {left} lower the cost no further, and the model has that many."]


def of_conditioning(fit: MeasuredFit, covariance: Array, hessian: Array) -> list[str]:
    """What the data do not determine, from covariance and ``sum psi psi'`` along the free directions.

    A delay or a pole at its bound is taken as known.
    """
    words = []
    if fit.status is Status.DELAY_AT_BOUND:
        reason = "because it stopped at a bound; the other standard errors take it as known"
        words.append(f"The delay has no standard error, {reason} and are too small if it is not.")
    if fit.held_poles:
        held = listed(f"{pole:.4g}" if pole.imag else f"{pole.real:.4g}" for pole in fit.held_poles)
        what = f"Held at the border of the admissible models: {held} (poles, rad per unit of time)"
        words.append(f"{what}{_of_limits(fit)}; the other standard errors take this as known.")
    names: list[str] = []
    values: list[float] = []
    for column in fit.tangent.T:
        place = int(np.argmax(np.abs(column)))
        own = np.count_nonzero(column) == 1
        names.append(fit.parameter_names[place] if own else f"pole {len(names) + 1}")
        values.append(fit.theta[place])
    found = describe_conditioning(covariance, np.array(values), names, condition_number(hessian), hessian)
    # At a bound and along a ridge the status has said why, and one sentence is enough.
    return [*words, *found[: 1 if fit.status in (Status.AT_BOUND, Status.RIDGE) else None]]


def _of_limits(fit: MeasuredFit) -> str:
    """Which bounds hold the poles, their values, and what that means."""
    met = () if fit.box is None else fit.box.limits_met(fit.held_poles)
    return "".join(f". The {limit.what} is {value:.4g}: {limit.meaning}" for _, limit, value in met)


def of_short_record(uncertainty: Uncertainty, count: int, offset: bool = False) -> list[str]:
    """Whether the noise is so slow, or an offset that was left, that the record hardly shows what the noise is."""
    if not uncertainty.short:
        return []
    worth = f"its {count} samples are worth {uncertainty.effective_count:.2g} independent ones"
    size = len(uncertainty.free_covariance)
    cure = "an offset looks like slow noise: treat it first (--offset)" if offset else "take a longer record"
    return [
        f"The record is too short for its noise: {worth}, and the model has {size} parameters. The intervals are "
        f"rough; {cure}."
    ]


def of_nonlinearity(names: Sequence[str]) -> list[str]:
    """Which intervals a linearisation cannot be trusted with."""
    if not names:
        return []
    what = f"intervals of {listed(names)} are" if len(names) > 1 else f"interval of {names[0]} is"
    return [
        f"The {what} unsafe: so far from the estimate the output is not linear in the parameters, and the truth lies "
        "outside more often than in 5 %. Take a longer record, or an input that tells more."
    ]


def of_interval(interval: DelayInterval | None, options: Options, fit: MeasuredFit) -> list[str]:
    """Whether the interval of the delay ends where its search ended."""
    if interval is None:
        return []
    low, high = options.delay_bounds
    # Below zero there is nothing left to search.
    ends = [f"{low:g}"] * (interval.open_low and low > 0) + [f"{high:g}"] * interval.open_high
    if not ends:
        return []
    reached = f"the end of its search range ({' and '.join(ends)})"
    if fit.model.delay == 0.0:
        # The status says that none is needed; to search further still would be odd advice.
        return [f"The record does not rule out a delay either: the interval of the delay reaches {reached}."]
    return [f"The interval of the delay reaches {reached}: delays beyond may fit as well; widen --delay."]


def of_residuals(tests: Sequence[ResidualTests], experiments: int, fewest: int) -> list[str]:
    """Tests that failed, or could not be made."""
    words = [
        (f"Experiment {k}: " if experiments > 1 else "") + test.sentence
        for k, test in enumerate(tests, start=1)
        if not (test.white and test.uncorrelated)
    ]
    if len(tests) < experiments:
        words.append(f"Fewer than {fewest} residuals are too few to test; standard errors take them as white.")
    return words


def of_treatment(gains: Mapping[str, float], options: Options) -> list[str]:
    """What else should be estimated, from the shares by which the cost would fall."""
    able = not isinstance(options, MeasuredSubmodels)
    advice = {
        "initial_state": "The record does not start at rest: estimating the initial state would lower the cost by "
        "{:.2g} %; use --initial-state estimate (or periodic, if the input repeats the record).",
        "offset": "The output has an offset: estimating it would lower the cost by {:.2g} %; use "
        + ("--offset estimate (or remove, to " if able else "--offset remove (to ")
        + "subtract the means of input and output).",
    }
    return [advice[name].format(100 * share) for name, share in gains.items()]


def of_validation(fitted: float, validated: float) -> list[str]:
    """Whether the model carries over to another record, from the coefficients of determination of both."""
    if not validated < 0.5 < fitted:
        return []
    return [
        f"The model explains {100 * fitted:.0f} % of the variance of the record it was estimated from, but only "
        f"{100 * max(validated, 0.0):.0f} % of the validation record's: it does not carry over."
    ]
