"""Intervals after a choice of the structure."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ctid_cli.estimation.measured_records import MeasuredRecords
from ctid_cli.estimation.optimum.best_model import Optimum
from ctid_cli.estimators.delay_profile import DelayProfile
from ctid_cli.estimators.identification import Identification
from ctid_cli.estimators.measured_fit import fitted
from ctid_cli.estimators.reported_parameters import determined, reported_parameters
from ctid_cli.identification.choice import Candidate, Choice
from ctid_cli.inference.intervals import NOT_DETERMINED, UncertainValue
from ctid_cli.signals.record import with_hold
from ctid_cli.signals.treatment import Holds

#: Quantities that a missing pole biases.
BIASED_BY_A_POLE = "delay", "static_gain"
OTHER_TREATMENTS = f"{NOT_DETERMINED}: its sign depends on the state before the record and the offset."
#: Sentences on these intervals.
JOINED = (
    "Intervals of the delay and the static gain are joined with those of a model with one pole more, as the number of "
    "poles was chosen."
)
JOINED_HOLDS = "Intervals of the delay and the static gain are joined with those for --hold {}, which fits as well."


def joined_with_holds(found: Identification, holds: Sequence[Holds]) -> Identification:
    """Return a fit whose intervals of the delay and the gain contain those of other holds that fit as well.

    A signal of straight lines leads that of constant values by half a sampling interval.
    """
    options = found.options
    for hold in holds if isinstance(options, DelayProfile) and not options.bounds else ():
        laid_out = options.prepare([with_hold(record, hold) for record in found.records]).laid_out
        text = JOINED_HOLDS.format(hold if isinstance(hold, str) else ", ".join(hold))
        assert isinstance(laid_out, MeasuredRecords)
        found = _joined_with(found, laid_out, laid_out.local(laid_out.begin(found.fit.model)), text)
    return found


def joined_with_larger(found: Identification, choice: Choice) -> Identification:
    """Return a fit whose intervals of the delay and the gain contain those of the best model with one pole more.

    The criterion may choose a pole too few, whose effect then is a part of the delay.
    """
    larger = _larger(choice)
    if larger is None or not (isinstance(larger.options, DelayProfile) and isinstance(choice.options, DelayProfile)):
        return found
    if choice.options.bounds:
        return found
    own = larger.options
    options = replace(choice.options, poles=own.poles, zeros=own.zeros, inputs=own.inputs, fixed=None)
    laid_out = options.prepare(choice.records).laid_out
    minimum = laid_out.with_least_delays(laid_out.local(laid_out.begin(larger.fit.model)))
    return _joined_with(found, laid_out, minimum, JOINED)


def _joined_with(found: Identification, laid_out: MeasuredRecords, minimum: Optimum, text: str) -> Identification:
    """Return a fit with intervals that contain those of another minimum, and a sentence on them."""
    if not found.answer.seen:
        return found
    other = fitted(laid_out, minimum, None)
    law = other.uncertainty("white" if found.uncertainty.kind == "white" else "robust")
    fit, models = determined(other._with_law(law), laid_out)
    reported = reported_parameters(fit, law, True, laid_out, models)
    others = {item.name: item for item in (*reported.estimates, *reported.derived)}
    estimates, derived = (
        tuple(_joined(item, others.get(item.name)) for item in items) for items in (found.estimates, found.derived)
    )
    if (estimates, derived) == (found.estimates, found.derived):
        return found
    return replace(found, estimates=estimates, derived=derived, choices=(*found.choices, text))


def with_other_gains(found: Identification, choice: Choice) -> Identification:
    """Return a fit whose gain is not determined, if its sign depends on the treatment of the records."""
    if not choice.gains:
        return found
    derived = tuple(
        item.undetermined(OTHER_TREATMENTS, choice.gains[item.name]) if item.name in choice.gains else item
        for item in found.derived
    )
    return replace(found, derived=derived)


def _larger(choice: Choice) -> Candidate | None:
    """Return the best candidate with a pole more than the chosen one."""
    best = choice.taken
    return next(
        (
            each
            for each in choice.ranking.candidates
            if each.options.order == best.options.order + 1
            and each.options.integrators == best.options.integrators
            and not each.fit.poles_at_infinity
        ),
        None,
    )


def _joined(item: UncertainValue, other: UncertainValue | None) -> UncertainValue:
    """Return a quantity with the interval from the least to the greatest end of both."""
    if other is None or not item.name.endswith(BIASED_BY_A_POLE):
        return item
    pairs = [
        pair
        for each in (item, other)
        for pair in (each.intervals or ((each.low, each.high),))
        if np.isfinite(pair).all()
    ]
    given = bool(item.intervals) or bool(np.isfinite([item.low, item.high]).all())
    if len(pairs) < 2 or not given:
        return item
    return item.with_intervals(((min(low for low, _ in pairs), max(high for _, high in pairs)),))
