"""A plan as plain data: what the stored estimates are compared with, sorted by and described from.

Journal and ``runs.h5`` keep the manifest, so that results can be listed, counted and exported without the specification
that made them. A shard is the part of a plan that one of several runs computes: whose a data set is follows from its
place in the plan and the number of shards alone, and what is dealt stays where it is when ``runs`` is raised.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from math import lcm
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn, Self

from ctid_cli.errors import UsageError
from ctid_cli.storage import columns
from ctid_cli.written_files import EXPERIMENT

if TYPE_CHECKING:
    from ctid_cli.models.additive import AdditiveModel
    from ctid_cli.models.several_inputs import MultiInputModel
    from ctid_cli.models.transfer_function import TransferFunction

Manifest = dict[str, Any]
#: Estimates that one plan may ask for.
MAX_ESTIMATES = 100_000_000


class Key(NamedTuple):
    """Identity of an estimate: what it was computed from."""

    data_hash: str
    replicate: int
    estimator_hash: str
    start: str

    @property
    def id(self) -> str:
        """Return short name of the estimate."""
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
        """Return values of the swept fields."""
        return {**self.cell["swept"], **self.estimator["swept"]}


@dataclass(frozen=True, order=True)
class Shard:
    """One of several shards, counted from 1."""

    number: int
    of: int

    def __str__(self) -> str:
        return f"shard {self.number} of {self.of}"

    @classmethod
    def read(cls, text: str) -> Self:
        """Return the shard that a text such as ``2/3`` names."""
        found = re.fullmatch(r"([0-9]{1,9})/([0-9]{1,9})", text)
        if found is None or not 1 <= int(found[1]) <= int(found[2]):
            raise UsageError(f"--shard {text}: write k/n, for example 2/3 for the second of three, with k from 1 to n")
        return cls(int(found[1]), int(found[2]))

    def folder(self, experiment: str) -> str:
        """Return name of the folder of its results."""
        return f"{experiment}.shard-{self.number}-of-{self.of}"

    def has(self, cell: int, replicate: int, cells: int) -> bool:
        """Return whether a data set is among those of this shard."""
        return owner(cell, replicate, cells, self.of) == self.number


def owner(cell: int, replicate: int, cells: int, of: int) -> int:
    """Return number of the shard that a data set is dealt to."""
    index = replicate * cells + cell
    # Dealt in turn, a number of cells that has a factor in common with that of the shards would give some shards the
    # same cells over and over; so each turn through both begins one shard later.
    return (index + index // lcm(cells, of)) % of + 1


def read_json(text: str) -> Any:
    """Return JSON without the numbers that it has no words for."""

    def refuse(constant: str) -> NoReturn:
        raise ValueError(f"{constant} is no JSON number")

    return json.loads(text, parse_constant=refuse)


def require_manifest(found: Any) -> Manifest:
    """Return the plan in an untrusted file; a ValueError says what is wrong with it."""
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
    """Return the number of estimates of a plan, whatever its shard."""
    data_sets: int = sum(cell["replicates"] for cell in plan["data_cells"])
    return data_sets * sum(len(estimator["starts"]) for estimator in plan["estimators"])


@cache
def _plan_model() -> Any:
    """Return what checks the form of a plan."""
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
    """Yield every estimate that a plan asks for, or that its shard is to compute."""
    for estimator, cell, replicates in planned_parts(manifest):
        for replicate in replicates:
            for start in estimator["starts"]:
                yield Slot(Key(cell["hash"], replicate, estimator["hash"], start), cell, estimator)


def planned_parts(manifest: Manifest) -> Iterator[tuple[Mapping[str, Any], Mapping[str, Any], Sequence[int]]]:
    """Yield every estimator on every data cell, in the order of the plan, with the data sets that are asked for."""
    cells, shard = manifest["data_cells"], shard_of(manifest)
    asked: list[Sequence[int]] = [range(cell["replicates"]) for cell in cells]
    if shard is not None:
        asked = [[k for k in some if shard.has(number, k, len(cells))] for number, some in enumerate(asked)]
    for estimator in manifest["estimators"]:
        for cell, replicates in zip(cells, asked, strict=True):
            if replicates:
                yield estimator, cell, replicates


def planned_count(manifest: Manifest) -> int:
    """Return how many estimates that are, those that two names share counted twice."""
    return sum(len(replicates) * len(estimator["starts"]) for estimator, _, replicates in planned_parts(manifest))


def shard_of(manifest: Manifest) -> Shard | None:
    """Return which shard of the experiment it is; None for the whole."""
    return Shard(*manifest["shard"]) if "shard" in manifest else None


def whole(manifest: Manifest) -> Manifest:
    """Return the plan that a shard was dealt from."""
    return {name: value for name, value in manifest.items() if name != "shard"}


def row_columns(manifest: Manifest) -> list[columns.Column]:
    """Return the columns of a row as it is computed, before it is compared with the truth."""
    here = {"all", "systems", "signals" if is_of_signal(manifest) else ""}
    return [column for column in columns.COLUMNS if column.of in here and column.source != "truth"]


def is_of_signal(manifest: Manifest) -> bool:
    """Return whether the estimates are frequencies of a signal."""
    return "signal" in manifest["data_cells"][0]["content"]


def swept_names(manifest: Manifest) -> list[str]:
    """Return names of the swept fields."""
    parts = [*manifest["data_cells"], *manifest["estimators"]]
    return list(dict.fromkeys(name for part in parts for name in part["swept"]))


def true_system(cell: Mapping[str, Any]) -> TransferFunction | AdditiveModel | MultiInputModel | None:
    """Return the system that a data cell simulates; None for a custom one, a measured record or a signal."""
    from ctid_cli.models.additive import AdditiveModel, Submodel
    from ctid_cli.models.several_inputs import MultiInputModel
    from ctid_cli.models.transfer_function import TransferFunction

    content = cell["content"]
    if inputs := content.get("inputs"):
        return MultiInputModel.of({name: TransferFunction(**one["system"]) for name, one in inputs.items()})
    system = content.get("system") or {}
    # An option of a custom system may be called delay.
    if "additive" in system:
        parts = [Submodel(**item) for item in system["additive"]]
        return AdditiveModel(parts, float(system.get("delay") or 0.0))
    if "denominator" in system:
        return TransferFunction(system["numerator"], system["denominator"], float(system.get("delay") or 0.0))
    return None


def true_values(cell: Mapping[str, Any]) -> dict[str, float]:
    """Return true values of the system that a data cell simulates, by name; empty for a measured record or a signal.

    ``a1`` ..., ``b0`` ..., ``delay`` of a transfer function, in descending powers with a monic denominator; the
    parameters of the submodels of a sum, and its delay; those of several inputs; what a custom system gives.
    """
    from ctid_cli.models.additive import AdditiveModel
    from ctid_cli.models.several_inputs import parameters_of

    model = true_system(cell)
    if model is None:
        return dict((cell["content"].get("system") or {}).get("truth") or {})
    return parameters_of(model.sorted() if isinstance(model, AdditiveModel) else model)
