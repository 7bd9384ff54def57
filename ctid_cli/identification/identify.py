"""A fit to measured records with its warnings."""

from collections.abc import Sequence

from ctid_cli.estimators import identification
from ctid_cli.estimators.identification import Identification
from ctid_cli.estimators.measured_submodels import Options
from ctid_cli.identification.fit_warnings import with_warnings
from ctid_cli.inference.uncertainty import DRAWS, Covariance, Progress
from ctid_cli.signals.record import Record


def identify(
    options: Options,
    records: Sequence[Record],
    validation: Record | None = None,
    covariance: Covariance = "auto",
    bootstrap_draws: int = DRAWS,
    progress: Progress | None = None,
) -> Identification:
    """Fit one model to the records and judge it.

    Parameters
    ----------
    options : DelayProfile or MeasuredSubmodels
        The estimator.
    records : sequence of Record
        One for each experiment.
    validation : Record, optional
        Another record of the same system; its initial state and offset are treated as those of the others, with the
        model fixed.
    covariance : {"auto", "white", "robust", "bootstrap"}, default "auto"
        What the noise is taken for: white unless the residuals are not, white, or coloured with standard errors and
        Student's t, or coloured with the intervals of a bootstrap-t.
    bootstrap_draws : int, default 500
        Simulated noise sequences of a bootstrap [-].
    progress : callable, optional
        Told after each of them how many of how many are done.

    Returns
    -------
    Identification
        The model and everything about it.

    Raises
    ------
    DataError
        If a record cannot be used.

    Notes
    -----
    Standard errors are those for white residuals if no experiment's residuals fail the test of whiteness, and those for
    coloured noise (:func:`~ctid_cli.inference.robust.robust_covariance`) otherwise. Intervals are those of Student's t
    with as many degrees of freedom as the record is worth independent samples, less the number of parameters. The delay
    has a profile-likelihood interval where the quadratic one is doubtful. Whether there is a model at all is tested
    against noise of the outputs' colour, the search over poles and delays included.
    """
    found = identification.identify(options, records, validation, covariance, bootstrap_draws, progress)
    return with_warnings(found)
