"""A plan as plain data: what the stored estimates are compared with, sorted by and described from.

The journal and the sealed file keep the manifest, so that results can be listed, counted and exported without the
specification that made them, also by later versions that read specifications differently. `storage.columns` says what
a row of the table of estimates holds.
"""

import hashlib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from ctid_cli.errors import RefusedError
from ctid_cli.storage import columns
from ctid_cli.storage.shards import Shard

Manifest = dict[str, Any]


class Key(NamedTuple):
    """Identity of an estimate: what it was computed from."""

    data_hash: str
    replicate: int
    estimator_hash: str
    start: str

    @property
    def id(self) -> str:
        """Short name of the estimate."""
        return hashlib.sha256(f"{self[0]}/{self[1]}/{self[2]}/{self[3]}".encode()).hexdigest()[:12]


class Outcome(NamedTuple):
    """One estimate, or how it failed."""

    #: Which estimate.
    key: Key
    #: Values of the columns that come from a result.
    result: dict[str, Any]
    #: Time for preparing the record and fitting [s]; None where nothing was measured.
    seconds: float | None
    #: The same of the processor [s].
    cpu_seconds: float | None = None


class Slot(NamedTuple):
    """One place in the table of estimates: which estimate belongs there and how it is labelled."""

    key: Key
    cell: Mapping[str, Any]
    estimator: Mapping[str, Any]

    @property
    def swept(self) -> dict[str, Any]:
        """Values of the swept fields."""
        return {**self.cell["swept"], **self.estimator["swept"]}


def refuse_newer(path: Path, written: int, known: int) -> None:
    """Refuse a file whose format is younger than this program."""
    if written > known:
        raise RefusedError(
            f"{path} has format {written}; this ctid reads formats up to {known}. Use the newer ctid that wrote it, "
            "another results folder (--out), or --fresh to move the old results aside"
        )


def slots(manifest: Manifest) -> Iterator[Slot]:
    """Every estimate that a plan asks for, or that its shard is to compute."""
    for estimator, cell, replicates in planned_parts(manifest):
        for replicate in replicates:
            for start in estimator["starts"]:
                yield Slot(Key(cell["hash"], replicate, estimator["hash"], start), cell, estimator)


def planned_parts(manifest: Manifest) -> Iterator[tuple[Mapping[str, Any], Mapping[str, Any], Sequence[int]]]:
    """Every estimator on every data cell, in the order of the plan, with the data sets that are asked for."""
    cells, shard = manifest["data_cells"], shard_of(manifest)
    asked: list[Sequence[int]] = [range(cell["replicates"]) for cell in cells]
    if shard is not None:
        asked = [[k for k in some if shard.has(number, k, len(cells))] for number, some in enumerate(asked)]
    for estimator in manifest["estimators"]:
        for cell, replicates in zip(cells, asked, strict=True):
            if replicates:
                yield estimator, cell, replicates


def planned_count(manifest: Manifest) -> int:
    """How many estimates that are, those that two names share counted twice."""
    return sum(len(replicates) * len(estimator["starts"]) for estimator, _, replicates in planned_parts(manifest))


def shares_estimates(manifest: Manifest) -> bool:
    """Whether two names of the same estimator, or data cell, share their estimates."""
    parts = [[part["hash"] for part in manifest[of]] for of in ("data_cells", "estimators")]
    return any(len(set(hashes)) < len(hashes) for hashes in parts)


def shard_of(manifest: Manifest) -> Shard | None:
    """Which shard of the experiment it is; None for the whole."""
    return Shard(*manifest["shard"]) if "shard" in manifest else None


def whole(manifest: Manifest) -> Manifest:
    """The plan that a shard was dealt from."""
    return {name: value for name, value in manifest.items() if name != "shard"}


def assemble(
    slot: Slot, manifest: Manifest, result: Mapping[str, Any], seconds: float | None, cpu_seconds: float | None
) -> dict[str, Any]:
    """An estimate row."""
    values = {**result, **plan_values(slot, manifest), "seconds": seconds, "cpu_seconds": cpu_seconds}
    return {column.name: values.get(column.name) for column in row_columns(manifest)} | slot.swept


def plan_values(slot: Slot, manifest: Manifest) -> dict[str, Any]:
    """What the plan says of an estimate, apart from swept fields."""
    return {
        "id": slot.key.id,
        "experiment": manifest["experiment"],
        "estimator": slot.estimator["name"],
        "kind": slot.estimator["kind"],
        "cell": slot.key.data_hash,
        "replicate": slot.key.replicate,
        "start": slot.key.start,
        "initial_delay": manifest["starts"].get(slot.key.start),
    }


def row_columns(manifest: Manifest) -> list[columns.Column]:
    """The columns of a row as it is computed, before it is compared with the truth."""
    return _row_columns(of_signal=is_of_signal(manifest))


@cache
def _row_columns(*, of_signal: bool) -> list[columns.Column]:
    here = {"all", "systems", "signals" if of_signal else ""}
    return [column for column in columns.COLUMNS if column.of in here and column.source != "truth"]


def is_of_signal(manifest: Manifest) -> bool:
    """Whether the estimates are frequencies of a signal."""
    return "signal" in manifest["data_cells"][0]["content"]


def swept_names(manifest: Manifest) -> list[str]:
    """Names of the swept fields."""
    parts = [*manifest["data_cells"], *manifest["estimators"]]
    return list(dict.fromkeys(name for part in parts for name in part["swept"]))


def true_values(cell: Mapping[str, Any]) -> dict[str, float]:
    """True values of the system that a data cell simulates, by name; empty for a measured record or a signal.

    ``a1`` ..., ``b0`` ..., ``delay`` of a transfer function, in descending powers with a monic denominator; the
    parameters of the submodels of a sum, and its delay; the truth that a system of one's own gives.
    """
    from ctid_cli.models.additive import AdditiveModel, Submodel
    from ctid_cli.models.transfer_function import TransferFunction

    system = cell["content"].get("system")
    if not system:
        return {}
    if "additive" in system:
        values = AdditiveModel([Submodel(**item) for item in system["additive"]]).sorted().parameters
    elif "denominator" in system:
        values = TransferFunction(system["numerator"], system["denominator"]).parameters
    else:
        return dict(system.get("truth") or {})
    return values | {"delay": float(system.get("delay") or 0.0)}


@cache
def _coefficients(names: tuple[str, ...]) -> tuple[int, int]:
    """How many of these names are coefficients of a denominator, and of a numerator."""
    poles, zeros = (sum(re.fullmatch(rf"{letter}\d+", name) is not None for name in names) for letter in "ab")
    return poles, zeros


class Found(NamedTuple):
    """Numbers of an estimate under the names of the true parameters; None where there is none."""

    values: dict[str, float | None]
    standard_errors: dict[str, float | None]
    #: Standard errors to each side of 95 % intervals [-].
    quantiles: dict[str, float | None]


def found_values(row: Mapping[str, Any], names: Iterable[str]) -> Found:
    """Estimated values, standard errors and quantiles of intervals under the names of the true ones.

    Coefficients go together by their power of s: of a model with more zeros than the system, ``b1`` may be what is
    ``b0`` in truth. Those of a model with another number of poles have nothing to be compared with.
    """
    wanted = tuple(names)
    errors, quantiles = (dict(row.get(name) or {}) for name in ("standard_errors", "quantiles"))
    values = dict(row.get("parameters") or {}) | {"delay": row.get("delay")}
    b, a = row.get("numerator"), row.get("denominator")
    poles, zeros = _coefficients(wanted)
    if a is not None and b is not None and poles == len(a) - 1 > 0:
        values |= {f"a{k}": value for k, value in enumerate(a[1:], start=1)}
        # A leading zero is dropped by the model; names keep their powers.
        own = max(len(b), _coefficients(tuple(errors))[1])
        padded = dict(enumerate(b, start=own - len(b)))
        shift = own - zeros
        values |= {f"b{k}": padded.get(k + shift, 0.0) for k in range(zeros)}
        for each in (errors, quantiles):
            each |= {f"b{k}": each.get(f"b{k + shift}") for k in range(zeros)} if shift else {}
    return Found(*({name: each.get(name) for name in wanted} for each in (values, errors, quantiles)))
