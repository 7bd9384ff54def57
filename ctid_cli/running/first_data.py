"""What is done before workers begin: kernels are compiled, and the first data sets are tried."""

import itertools
import warnings
from collections.abc import Callable, Iterator

from ctid_cli.errors import DataError
from ctid_cli.running.custom_check import check_components
from ctid_cli.running.job import Job
from ctid_cli.running.limits import Limits
from ctid_cli.running.plan import Plan
from ctid_cli.simulation.components import CustomEstimation

#: Data cells whose first data set is tried.
TRIED = 64


def check_first_data(plan: Plan, jobs: Iterator[Job], limits: Limits, warn: Callable[[str], object]) -> None:
    """Refuse a plan whose first data sets no estimator can use.

    One record in a thousand that cannot be used is a result; the very first one is a mistake in the specification.
    """
    if check_components(plan, limits, warn):
        # No process but a worker should make data with custom components.
        return
    for job in itertools.islice(itertools.takewhile(lambda job: not job.replicate, jobs), TRIED):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                data = job.cell.dataset(job.replicate)
                for estimator in {id(cell): cell for _, cell, _ in job.wanted}.values():
                    estimator.estimator.prepare(data.record)
        except DataError:
            raise
        except Exception:
            # Any other failure is for the worker to record, with its place in the code.
            continue


def compile_kernels(plan: Plan) -> None:
    """Compile the kernels that a plan needs, or load them from the cache on disk, so that no two workers do."""
    from ctid_cli.estimation import compilation
    from ctid_cli.signals.sampling import RegularSampling
    from ctid_cli.simulation.frequency_measures import FrequencyEstimation, SignalSource

    source = plan.data_cells[0].source
    if isinstance(source, SignalSource):
        for cell in plan.estimators:
            if isinstance(cell.estimator, FrequencyEstimation):
                cell.estimator.compile(source.sampling.interval)
        return
    ours = [cell.estimator for cell in plan.estimators if not isinstance(cell.estimator, CustomEstimation)]
    clocks = [(getattr(cell.source, "sampling", None), getattr(cell.source, "loop", None)) for cell in plan.data_cells]
    # A clock that is not known before the data are read is taken as regular.
    for regular, closed in {(isinstance(clock, RegularSampling | None), loop is not None) for clock, loop in clocks}:
        compilation.compile_kernels(ours, regular=regular, closed=closed)
