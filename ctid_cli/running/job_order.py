"""In which order the data sets of a run are computed, so that no worker is left waiting at its end."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import groupby

from ctid_cli.running.job import Job
from ctid_cli.storage.manifest import Outcome


class JobQueue:
    """Jobs in the order of the plan, but the longest of a replicate first.

    Replicates stay in order: a run that is stopped has as many data sets of one cell as of another. What an estimate
    takes is known from those of the same cell and estimator; unknown ones come first. The last replicate is split into
    estimators, which are spread more evenly than whole data sets.
    """

    def __init__(self, jobs: Iterable[Job]) -> None:
        self._rounds = (list(group) for _, group in groupby(jobs, key=lambda job: job.replicate))
        self._seconds: dict[tuple[str, str], float] = {}
        #: The jobs of the present replicate and of the next one; those of others are not made yet.
        self._round, self._next = next(self._rounds, []), next(self._rounds, [])
        self._split_last()

    def __bool__(self) -> bool:
        return bool(self._round)

    def pop(self) -> Job:
        """The next job."""
        job = max(self._round, key=self._expected)
        self._round.remove(job)
        if not self._round:
            self._round, self._next = self._next, next(self._rounds, [])
            self._split_last()
        return job

    def learn(self, outcomes: Sequence[Outcome]) -> None:
        """Note how long estimates took."""
        for key, _, seconds, _ in outcomes:
            self._seconds[key.data_hash, key.estimator_hash] = seconds or 0.0

    def _expected(self, job: Job) -> float:
        return sum(self._seconds.get((key.data_hash, key.estimator_hash), float("inf")) for key, _, _ in job.wanted)

    def _split_last(self) -> None:
        if not self._next:
            self._round = [
                replace(job, wanted=tuple(wanted))
                for job in self._round
                for _, wanted in groupby(job.wanted, key=lambda one: one[0].estimator_hash)
            ]
