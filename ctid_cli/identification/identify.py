"""Fit of a model to records; what is not given is chosen."""

from collections.abc import Sequence
from dataclasses import replace
from typing import get_args

from ctid_cli.errors import DataError
from ctid_cli.estimators import identification
from ctid_cli.estimators.identification import Identification, Options
from ctid_cli.identification.choice import Given
from ctid_cli.identification.choose import choose
from ctid_cli.identification.chosen_intervals import joined_with_holds, joined_with_larger, with_other_gains
from ctid_cli.identification.fit_warnings import with_warnings
from ctid_cli.identification.validation import laid_out_for, validated_on
from ctid_cli.inference.uncertainty import DRAWS, Covariance, Progress
from ctid_cli.processors import one_thread
from ctid_cli.signals.record import Record, as_records, with_hold
from ctid_cli.text import listed


@one_thread
def identify(
    records: Record | Sequence[Record],
    options: Options | Given | None = None,
    validation: Record | None = None,
    covariance: Covariance = "auto",
    bootstrap_draws: int = DRAWS,
    progress: Progress | None = None,
    time_unit: str = "s",
) -> Identification:
    """Fit a model to records and assess it; structure and treatment are chosen unless given.

    Parameters
    ----------
    records : Record or sequence of Record
        One record for each experiment.
    options : DelayProfile, AdditiveOutputError, MeasuredSubmodels or Given, optional
        An estimator, with which nothing is chosen, or given options; by default everything is chosen, including the
        hold of the input if it is known at the samples of the output.
    validation : Record, optional
        Another record of the same system, which the choice never uses. Its state and offset are chosen on it, with the
        model fixed, unless they are given.
    covariance : {"auto", "white", "robust", "bootstrap"}, default "auto"
        Assumed noise: white unless the residuals are not, white, or coloured with standard errors and Student's t, or
        coloured with the intervals of a bootstrap-t.
    bootstrap_draws : int, default 500
        Number of simulated noise sequences of a bootstrap [-].
    progress : callable, optional
        Called after each of them with the number done and the total.
    time_unit : str, default "s"
        Unit of the records' times, for the sentences.

    Returns
    -------
    Identification
        The model with its diagnostics; ``choices`` has a sentence for each choice.

    Raises
    ------
    DataError
        If a record cannot be used, or no response to its input is detected and no number of poles is given.
    OptionError
        If given options contradict each other.
    TypeError
        If the options are those of another estimator, which has only its own ``fit``.

    Notes
    -----
    All choices use one criterion, BIC of the innovations with a noise model common to all candidates and 1.5 times the
    usual penalty; see :func:`~ctid_cli.identification.choose.choose`.

    Examples
    --------
    >>> import numpy as np
    >>> from ctid_cli import HeldSignal, Record, TransferFunction, identify, simulate
    >>> t = 0.1 * np.arange(400)
    >>> signal = HeldSignal(t, np.sign(np.sin(0.4 * t**1.5)))
    >>> noise = 0.05 * np.random.default_rng(0).standard_normal(400)
    >>> found = identify(Record(t, simulate(TransferFunction([2.0], [1.0, 1.0]), signal, t) + noise, signal))
    >>> found.options.poles, found.options.initial_state
    (1, 'rest')
    """
    several = as_records(records)
    if not isinstance(options, Options | Given | None):
        what = f"options of identify must be {listed(each.__name__ for each in get_args(Options))} or Given"
        raise TypeError(f"{what}, not {type(options).__name__}; any estimator fits by itself: estimator.fit(record)")
    noise = covariance, bootstrap_draws, progress
    if options is not None and not isinstance(options, Given):
        found = identification.identify(options, several, validation, *noise)
        likely = found.fit.assumed_hold.others if found.fit.assumed_hold else ()
        before = getattr(options, "input_before", None)
        level = before if isinstance(before, float | int) else None
        known = Given(initial_state=options.initial_state, input_before=level, hold=several[0].hold)
        return with_warnings(joined_with_holds(found, likely), time_unit, _free(known))
    given = options or Given()
    choice = choose(several, given, time_unit)
    if given.poles is None and not given.typed and not choice.has_model:
        what = "number of poles (--poles)" if given.modes is None else "submodels (--terms)"
        raise DataError(
            f"{choice.why_no_model} Input and output may be exchanged; else give the {what} to fit a model "
            "all the same."
        )
    other = None if validation is None else with_hold(validation, choice.records[0].hold)
    if other is not None:
        # Checked before the fit, which takes longer.
        laid_out_for(other, choice.options, given)
    found = identification.identify(choice.options, choice.records, None, *noise)
    found = replace(found, choices=choice.sentences)
    found = joined_with_holds(with_other_gains(found, choice), choice.holds)
    if not given.single:
        found = joined_with_larger(found, choice)
    if other is not None:
        found = replace(found, validation=validated_on(other, choice.options, found.fit, given))
    typed = given.typed or isinstance(given.poles, int)
    return with_warnings(found, time_unit, _free(given) if typed else None)


def _free(given: Given) -> Given:
    """Return the given options that a free choice keeps: what is known of the input, and the loss."""
    periodic = given.initial_state if given.initial_state == "periodic" else None
    return Given(initial_state=periodic, hold=given.hold, input_before=given.input_before, loss=given.loss)
