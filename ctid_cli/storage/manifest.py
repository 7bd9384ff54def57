"""A plan as plain data: what the stored estimates are compared with, sorted by and described from.

The journal and the sealed file keep the manifest, so that results can be listed, counted and exported without the
specification that made them, also by later versions that read specifications differently.

Keys of an estimate row
-----------------------
- ``id``: short name; ``experiment``, ``estimator``, ``kind``; ``cell``: hash of the data cell; ``replicate``;
  ``start``: its label.
- ``initial_delay``: where the search was asked to start [s], ``"random"``, or None for estimators without a start;
  ``start_delay``: where it did start [s].
- ``status``: name of a `Status`, or ``FAILED`` (the estimator raised an exception), ``CRASHED`` (its process died),
  ``TIMEOUT``; ``message``: what that means, or the exception with a short traceback.
- ``delay`` [s], ``numerator`` and ``denominator`` (monic, descending powers), ``standard_errors`` by parameter name.
- ``parameters`` of the submodels by name, only in experiments whose system or estimators are additive: ``g1_a1``
  multiplies the first power of p in the denominator of the submodel with the least natural frequency.
- ``cost`` [output unit^2], ``fit_percent``, ``validation_fit_percent``, ``iterations``, ``condition_number``.
- ``measures`` of estimated frequencies by name, only in experiments on a signal; see
  `ctid_cli.simulation.frequency_measures`. Their ``status`` is ``VALID`` or ``INVALID``, or one of the failures.
- ``seconds``: time for preparing the record and fitting, as if the estimate had been alone [s].
- one key per swept field. None stands for a value that does not exist or is not finite.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

Manifest = dict[str, Any]

#: What an estimator returns, in the order of the columns.
RESULT_FIELDS = (
    "status",
    "message",
    "start_delay",
    "delay",
    "numerator",
    "denominator",
    "parameters",
    "standard_errors",
    "cost",
    "fit_percent",
    "validation_fit_percent",
    "iterations",
    "condition_number",
)
#: Statuses of estimates that have no result because something went wrong.
FAILURES = ("FAILED", "CRASHED", "TIMEOUT")


class Key(NamedTuple):
    """Identity of an estimate: what it was computed from."""

    data_hash: str
    replicate: int
    estimator_hash: str
    start: str

    @property
    def id(self) -> str:
        """Short name of the estimate."""
        return hashlib.sha256("/".join(map(str, self)).encode()).hexdigest()[:12]


class Slot(NamedTuple):
    """One place in the table of estimates: which estimate belongs there and how it is labelled."""

    key: Key
    cell: Mapping[str, Any]
    estimator: Mapping[str, Any]


class Outcome(NamedTuple):
    """One estimate, or how it failed."""

    #: Which estimate.
    key: Key
    #: Values of `RESULT_FIELDS`.
    result: dict[str, Any]
    #: Time for preparing the record and fitting [s]; None where nothing was measured.
    seconds: float | None


def slots(manifest: Manifest) -> Iterator[Slot]:
    """Every estimate that a plan asks for."""
    for estimator in manifest["estimators"]:
        for cell in manifest["data_cells"]:
            for replicate in range(cell["replicates"]):
                for start in estimator["starts"]:
                    yield Slot(Key(cell["hash"], replicate, estimator["hash"], start), cell, estimator)


def assemble(slot: Slot, manifest: Manifest, result: Mapping[str, Any], seconds: float | None) -> dict[str, Any]:
    """An estimate row."""
    return {
        "id": slot.key.id,
        "experiment": manifest["experiment"],
        "estimator": slot.estimator["name"],
        "kind": slot.estimator["kind"],
        "cell": slot.key.data_hash,
        "replicate": slot.key.replicate,
        "start": slot.key.start,
        "initial_delay": manifest["starts"].get(slot.key.start),
        **{name: result.get(name) for name in RESULT_FIELDS if name != "parameters" or is_additive(manifest)},
        **({"measures": result.get("measures")} if is_of_signal(manifest) else {}),
        "seconds": seconds,
        **slot.cell["swept"],
        **slot.estimator["swept"],
    }


def is_additive(manifest: Manifest) -> bool:
    """Whether estimates have parameters of submodels."""
    # One system for all data cells.
    system = next((cell["content"].get("system") for cell in manifest["data_cells"]), None)
    return "additive" in (system or {}) or any("terms" in part["content"] for part in manifest["estimators"])


def is_of_signal(manifest: Manifest) -> bool:
    """Whether the estimates are frequencies of a signal."""
    return any("signal" in cell["content"] for cell in manifest["data_cells"])


def swept_names(manifest: Manifest) -> list[str]:
    """Names of the swept fields."""
    parts = [*manifest["data_cells"], *manifest["estimators"]]
    return list(dict.fromkeys(name for part in parts for name in part["swept"]))


def true_delay(cell: Mapping[str, Any]) -> float | None:
    """Delay of the system that a data cell simulates."""
    system = cell["content"].get("system")
    return None if not system else float(system.get("delay") or 0.0)


def true_parameters(cell: Mapping[str, Any]) -> dict[str, float] | None:
    """Parameters of the submodels of the system that a data cell simulates."""
    from ctid_cli.models.additive import AdditiveModel, Submodel

    system = cell["content"].get("system")
    if not system or "additive" not in system:
        return None
    return AdditiveModel([Submodel(**item) for item in system["additive"]]).sorted().parameters
