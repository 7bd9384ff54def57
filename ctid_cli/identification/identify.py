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
    """Fit one model to records and judge it, as :func:`ctid_cli.estimators.identification.identify`, with warnings."""
    found = identification.identify(options, records, validation, covariance, bootstrap_draws, progress)
    return with_warnings(found)
