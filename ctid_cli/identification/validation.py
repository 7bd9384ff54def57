"""Models on a record from which they were not estimated, with its own state and offset."""

from dataclasses import replace

import numpy as np

from ctid_cli.estimation.measured_records import MeasuredRecords
from ctid_cli.estimators.identification import Validation, laid_out_validation, validated
from ctid_cli.estimators.measured_fit import MeasuredFit
from ctid_cli.identification.choice import Given
from ctid_cli.identification.criterion import Searched, criteria_of
from ctid_cli.identification.initial_states import states_of
from ctid_cli.signals.record import Record
from ctid_cli.signals.treatment import Offset


def laid_out_for(record: Record, options: Searched, given: Given) -> list[tuple[Searched, MeasuredRecords]]:
    """Prepare a record in all treatments of state and offset to compare; a DataError if it cannot be used."""
    offsets: list[Offset] = ["estimate", "none"] if given.offset is None else [given.offset]
    tried = [
        replace(options, initial_state=state, input_before=before, offset=offset)
        for state, before in states_of([record], given)
        for offset in offsets
    ]
    pairs = ((each, laid_out_validation(each, record)) for each in tried)
    return [(each, laid_out) for each, laid_out in pairs if isinstance(laid_out, MeasuredRecords)]


def validated_on(record: Record, options: Searched, fit: MeasuredFit, given: Given) -> Validation:
    """Assess a fixed model on a record, in the treatment that the criterion prefers."""
    tried = laid_out_for(record, options, given)
    applied = [own._applied(fit, laid_out) for own, laid_out in tried]
    common = np.logical_and.reduce([each.used[0] for each in applied])
    left = [each.residuals[0][common[each.used[0]]] for each in applied]
    sizes = [laid_out.layout.own for _, laid_out in tried]
    best = int(np.argmin(criteria_of([([e], [np.zeros((e.size, 0))]) for e in left], sizes)))
    return replace(validated(applied[best], record), options=tried[best][0])
