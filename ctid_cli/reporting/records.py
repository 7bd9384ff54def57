"""Measured records of a result: their files, columns and units."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any

from ctid_cli.errors import DataError
from ctid_cli.estimators.identification import Identification
from ctid_cli.inference.units import Units
from ctid_cli.signals.measurement import Measurement
from ctid_cli.signals.record import Record
from ctid_cli.signals.table import ROLES
from ctid_cli.text import count


@dataclass(frozen=True)
class Records:
    """Records of one command, with the units that all of them share."""

    measurements: Sequence[Measurement]
    validation: Measurement | None = None

    @property
    def data(self) -> list[Record]:
        """The records themselves."""
        return [each.record for each in self.measurements]

    @property
    def all(self) -> list[Record]:
        """The records and the one for validation."""
        return [*self.data, *filter(None, [self.validation_record])]

    @property
    def validation_record(self) -> Record | None:
        """The record for validation."""
        return None if self.validation is None else self.validation.record

    def treated(self, treat: Callable[[Measurement], Measurement]) -> Records:
        """Return all measurements after a treatment."""
        return Records(list(map(treat, self.measurements)), self.validation and treat(self.validation))

    def of_fit(self, fitted: Identification) -> Records:
        """Return the same files with their records as a fit has treated them."""
        measured = [
            replace(each, record=record) for each, record in zip(self.measurements, fitted.records, strict=True)
        ]
        other, validation = self.validation, fitted.validation
        if other is not None and validation is not None:
            other = replace(other, record=validation.record)
        return Records(measured, other)

    @cached_property
    def units(self) -> Units:
        """Units that all records share.

        Raises
        ------
        DataError
            If two records have different units.
        """
        found: dict[str, str] = {}
        for role in ROLES:
            for measurement in filter(None, [*self.measurements, self.validation]):
                unit = getattr(measurement, f"{role}_unit")
                if unit is not None and found.setdefault(role, unit) != unit:
                    where = f"{measurement.record.name}: the {role} is in {unit}, that of another file in {found[role]}"
                    raise DataError(f"{where}; files of one command must have the same units")
        return Units(**found)

    @property
    def names(self) -> str:
        """Names of the files."""
        return ", ".join(each.record.name for each in self.measurements)

    @property
    def line(self) -> str:
        """Files and number of samples."""
        return f"{self.names}: {count(sum(record.n_samples for record in self.data), 'sample')}"

    @property
    def notes(self) -> list[str]:
        """Notes from reading the records, each once."""
        return list(dict.fromkeys(note for each in self.measurements for note in each.notes))

    def content(self) -> dict[str, Any]:
        """Return files, columns and units for JSON."""
        first = self.measurements[0]
        columns = {"time": first.time, "input": first.columns, "output": first.output}
        files = [record.name for record in self.data]
        return {"files": files, "columns": columns, "units": asdict(self.units)}
