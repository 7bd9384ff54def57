"""A plan as plain data (manifest), used to compare, sort and describe stored estimates.

Journal and ``runs.h5`` keep the manifest, so that results can be listed, counted and exported without their
specification. A shard is the part of a plan that one of several runs computes: the shard of a data set depends only on
its place in the plan and the number of shards, and does not change when ``runs`` is increased.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from math import lcm
from typing import TYPE_CHECKING, Any, NamedTuple, Self

from ctid_cli.errors import UsageError
from ctid_cli.storage import columns
from ctid_cli.written_files import EXPERIMENT

if TYPE_CHECKING:
    from ctid_cli.models.several_inputs import SystemModel

Manifest = dict[str, Any]
#: Maximum number of estimates of one plan.
MAX_ESTIMATES = 100_000_000


class Key(NamedTuple):
    """Identity of an estimate: the inputs of its computation."""

    data_hash: str
    replicate: int
    estimator_hash: str
    start: str

    @property
    def id(self) -> str:
        """Short name of the estimate."""
        return hashlib.sha256(f"{self[0]}/{self[1]}/{self[2]}/{self[3]}".encode()).hexdigest()[:12]


class Outcome(NamedTuple):
    """One estimate or its failure."""

    #: Identity of the estimate.
    key: Key
    #: Values of the columns with source "result".
    result: dict[str, Any]
    #: Wall time for preparing the record and fitting [s]; None if not measured.
    seconds: float | None
    #: Processor time for preparing the record and fitting [s].
    cpu_seconds: float | None = None


class Slot(NamedTuple):
    """A place in the table of estimates: key and labels of the estimate."""

    key: Key
    cell: Mapping[str, Any]
    estimator: Mapping[str, Any]

    @property
    def swept(self) -> dict[str, Any]:
        """Values of the swept fields."""
        return {**self.cell["swept"], **self.estimator["swept"]}


@dataclass(frozen=True, order=True)
class Shard:
    """One shard of several, numbered from 1."""

    number: int
    of: int

    def __str__(self) -> str:
        return f"shard {self.number} of {self.of}"

    @classmethod
    def read(cls, text: str) -> Self:
        """Return the shard given by a text such as ``2/3``."""
        found = re.fullmatch(r"([0-9]{1,9})/([0-9]{1,9})", text)
        if found is None or not 1 <= int(found[1]) <= int(found[2]):
            raise UsageError(f"--shard {text}: write k/n, for example 2/3 for the second of three, with k from 1 to n")
        return cls(int(found[1]), int(found[2]))

    def folder(self, experiment: str) -> str:
        """Return the name of its results folder."""
        return f"{experiment}.shard-{self.number}-of-{self.of}"

    def has(self, cell: int, replicate: int, cells: int) -> bool:
        """Return whether a data set belongs to this shard."""
        return owner(cell, replicate, cells, self.of) == self.number


def owner(cell: int, replicate: int, cells: int, of: int) -> int:
    """Return the number of the shard of a data set."""
    index = replicate * cells + cell
    # Assigned in turn, if the number of cells has a factor in common with the number of shards, some shards would
    # always get the same cells; so each pass through both starts one shard later.
    return (index + index // lcm(cells, of)) % of + 1


def require_manifest(found: Any) -> Manifest:
    """Return the plan of an untrusted file; a ValueError describes what is wrong."""
    from pydantic import ValidationError

    try:
        plan: Manifest = found
        _plan_model().model_validate(found)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False, include_input=False)[0]
        raise ValueError(f"its plan: {'.'.join(map(str, first['loc']))}: {first['msg']}") from None
    if not re.fullmatch(EXPERIMENT, plan["experiment"]):
        raise ValueError("its experiment has a name that none may have")
    if not all(set(estimator["starts"]) <= plan["starts"].keys() for estimator in plan["estimators"]):
        raise ValueError("a start is not described")
    number, of = plan.get("shard", (1, 1))
    if not 1 <= number <= of:
        raise ValueError("its shard is none")
    if planned_most(plan) > MAX_ESTIMATES:
        raise ValueError(f"{planned_most(plan)} planned estimates are too many")
    return plan


def planned_most(plan: Manifest) -> int:
    """Return the number of estimates of a whole plan, ignoring shards."""
    data_sets: int = sum(cell["replicates"] for cell in plan["data_cells"])
    return data_sets * sum(len(estimator["starts"]) for estimator in plan["estimators"])


@cache
def _plan_model() -> Any:
    """Return the validator of the form of a plan."""
    from typing import Annotated

    from pydantic import BaseModel, Field, FiniteFloat

    text = Annotated[str, Field(min_length=1, max_length=1000)]
    whole_number = Annotated[int, Field(strict=True, ge=0, lt=2**63)]
    number = Annotated[FiniteFloat, Field(strict=True)]
    rule = dict[str, number | list[number] | None] | None

    class Content(BaseModel):
        system: dict[str, Any] | None = None

    class Cell(BaseModel):
        hash: text
        replicates: whole_number
        swept: dict[str, Any]
        content: Content

    class Estimator(BaseModel):
        name: text
        kind: text
        hash: text
        swept: dict[str, Any]
        content: dict[str, Any]
        starts: Annotated[list[str], Field(min_length=1)]

    class Spec(BaseModel):
        success: rule = None

    class Plan(BaseModel):
        experiment: text
        runs: whole_number
        seed: whole_number | None = None
        spec_hash: text
        spec: Spec
        success: rule
        starts: dict[str, number | str | None]
        data_cells: Annotated[list[Cell], Field(min_length=1)]
        estimators: Annotated[list[Estimator], Field(min_length=1)]
        shard: tuple[whole_number, whole_number] = (1, 1)

    return Plan


def slots(manifest: Manifest) -> Iterator[Slot]:
    """Yield the place of every estimate in a plan or its shard."""
    for estimator, cell, replicates in planned_parts(manifest):
        for replicate in replicates:
            for start in estimator["starts"]:
                yield Slot(Key(cell["hash"], replicate, estimator["hash"], start), cell, estimator)


def planned_parts(manifest: Manifest) -> Iterator[tuple[Mapping[str, Any], Mapping[str, Any], Sequence[int]]]:
    """Yield every estimator on every data cell with its data sets, in the order of the plan."""
    cells, shard = manifest["data_cells"], shard_of(manifest)
    requested: list[Sequence[int]] = [range(cell["replicates"]) for cell in cells]
    if shard is not None:
        requested = [[k for k in some if shard.has(number, k, len(cells))] for number, some in enumerate(requested)]
    for estimator in manifest["estimators"]:
        for cell, replicates in zip(cells, requested, strict=True):
            if replicates:
                yield estimator, cell, replicates


def planned_count(manifest: Manifest) -> int:
    """Return the number of planned estimates; estimates shared by two names count twice."""
    return sum(len(replicates) * len(estimator["starts"]) for estimator, _, replicates in planned_parts(manifest))


def shard_of(manifest: Manifest) -> Shard | None:
    """Return the shard of a plan; None for a whole experiment."""
    return Shard(*manifest["shard"]) if "shard" in manifest else None


def whole(manifest: Manifest) -> Manifest:
    """Return the whole plan of a shard."""
    return {name: value for name, value in manifest.items() if name != "shard"}


def row_columns(manifest: Manifest) -> list[columns.Column]:
    """Return the columns of a row as computed, before comparison with the true values."""
    here = {"all", "systems", "signals" if is_of_signal(manifest) else ""}
    return [column for column in columns.COLUMNS if column.of in here and column.source != "truth"]


def is_of_signal(manifest: Manifest) -> bool:
    """Return whether the estimates are frequencies of a signal."""
    return "signal" in manifest["data_cells"][0]["content"]


def swept_names(manifest: Manifest) -> list[str]:
    """Return the names of the swept fields."""
    parts = [*manifest["data_cells"], *manifest["estimators"]]
    return list(dict.fromkeys(name for part in parts for name in part["swept"]))


def true_system(cell: Mapping[str, Any]) -> SystemModel | None:
    """Return the system of a data cell; None for a custom system, a measured record or a signal."""
    from ctid_cli.models.additive import AdditiveModel, Submodel
    from ctid_cli.models.several_inputs import MultiInputModel
    from ctid_cli.models.transfer_function import TransferFunction

    content = cell["content"]
    if inputs := content.get("inputs"):
        return MultiInputModel.of({name: TransferFunction(**one["system"]) for name, one in inputs.items()})
    system = content.get("system") or {}
    # A custom system may have an option named delay.
    if "additive" in system:
        parts = [Submodel(**item) for item in system["additive"]]
        return AdditiveModel(parts, float(system.get("delay") or 0.0))
    if "denominator" in system:
        return TransferFunction(system["numerator"], system["denominator"], float(system.get("delay") or 0.0))
    return None


def true_values(cell: Mapping[str, Any]) -> dict[str, float]:
    """Return the true values of the simulated system by name; empty for a measured record or a signal.

    These are ``a1`` ..., ``b0`` ..., ``delay`` of a transfer function, in descending powers with a monic denominator;
    the submodel parameters of a sum, and its delay; those of several inputs; or the values given by a custom system.
    """
    from ctid_cli.models.additive import AdditiveModel
    from ctid_cli.models.several_inputs import parameters_of

    model = true_system(cell)
    if model is None:
        return dict((cell["content"].get("system") or {}).get("truth") or {})
    return parameters_of(model.sorted() if isinstance(model, AdditiveModel) else model)
