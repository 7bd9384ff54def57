"""Units of a record and of the parameters of its models."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

from ctid_cli.errors import DataError
from ctid_cli.models.additive import AdditiveModel
from ctid_cli.signals.measurement import SEPARATOR, Measurement
from ctid_cli.signals.sampled_signal import SECONDS
from ctid_cli.signals.table import Role, split_header

#: Placeholders of unknown units of input and output.
INPUT, OUTPUT = "in", "out"
UNKNOWN = {INPUT, OUTPUT}
#: Units of several factors, which a division encloses in parentheses.
COMPOUND = re.compile(r"[/*·\s]")


@dataclass(frozen=True)
class Units:
    """Units of a record, from which those of model parameters follow."""

    time: str = "s"
    input: str = INPUT
    output: str = OUTPUT

    def require_same(self, where: str, others: Mapping[str, str | None], what: str = "the model is") -> None:
        """Raise an error if signals have other units than a model; missing labels are ignored."""
        for role, unit in others.items():
            own = getattr(self, role)
            if unit not in (None, own) and self.is_known(own) and self.is_known(str(unit)):
                raise DataError(f"{where}: the {role} is in {unit}, and {what} in {own}; convert one of them")

    @property
    def gain(self) -> str:
        """Unit of a static gain."""
        divisor = f"({self.input})" if COMPOUND.search(self.input) else self.input
        return f"{self.output}/{divisor}"

    def label(self, name: str, unit: str) -> str:
        """Return a name with its unit in brackets, if known."""
        return f"{name} [{unit}]" if self.is_known(unit) else name

    def column(self, measurement: Measurement, role: Role) -> str:
        """Return the name of a column of a record with its unit; for several inputs all of them."""
        names = measurement.inputs if role == "input" and measurement.inputs else (str(getattr(measurement, role)),)
        return SEPARATOR.join(
            self.label(split_header(name)[0], getattr(self.of_input(k), role)) for k, name in enumerate(names)
        )

    def of_input(self, k: int) -> "Units":
        """Return the units of one of several inputs, whose labels are joined by a separator."""
        labels = self.input.split(SEPARATOR)
        return replace(self, input=labels[k]) if len(labels) > 1 else self

    def amount(self, text: str, unit: str) -> str:
        """Return a number with its unit, if known."""
        return f"{text} {unit}" if self.is_known(unit) else text

    def is_known(self, unit: str) -> bool:
        """Return whether a unit contains no placeholder."""
        return UNKNOWN.isdisjoint(re.findall(r"\w+", unit))

    @property
    def square(self) -> str:
        """Unit of a squared output."""
        return f"{self.output}^2" if self.output.isalpha() else f"({self.output})^2"

    @property
    def seconds(self) -> float | None:
        """Seconds in the unit of time; None for an unknown label."""
        return SECONDS.get(self.time)

    def of(self, name: str, poles: int, zeros: int) -> str:
        """Return the unit of a parameter."""
        if name == "delay":
            return self.time
        if name.startswith("offset"):
            return self.output
        if name.startswith("drift"):
            return self._times(self.output, -1 if name[5:6] in ("", "_") else -int(name[5]))
        k = int(name[1:].split("_")[0])
        unit, power = {"a": ("1", k), "b": (self.gain, poles - zeros + k)}.get(name[0], (self.output, k - 1))
        return self._times(unit, -power)

    def of_submodel(self, name: str, integrators: int = 0) -> str:
        """Return the unit of a parameter of a submodel, whose denominator has the constant term 1."""
        coefficient = name.split("_")[1]
        power = int(coefficient[1:])
        return self._times("", power) if coefficient[0] == "a" else self._times(self.gain, power - integrators)

    def in_sum(self, name: str, model: AdditiveModel, monic: bool = False) -> str:
        """Return the unit of a parameter of a sum, or of a coefficient of its free response.

        The free response is the impulse response of ``c_k p^k/(p^l A)``; with monic denominators the coefficients are
        in descending powers.
        """
        if name.startswith("g"):
            return self.of_submodel(name, model.submodels[int(name[1:].partition("_")[0]) - 1].integrators)
        if not name.startswith("x"):
            return self.of(name, 0, 0)
        if monic:
            places = [k for part in model.submodels for k in range(1, part.order + 1)]
            return self.of(f"x{places[int(name[1:].partition('_')[0]) - 1]}", 0, 0)
        powers = [k + 1 - part.integrators for part in model.submodels for k in range(part.order)]
        return self._times(self.output, powers[int(name[1:]) - 1])

    def _times(self, unit: str, power: int) -> str:
        """Return a unit times a power of the time."""
        if power == 0:
            return unit
        time = self.time if abs(power) == 1 else f"{self.time}^{abs(power)}"
        return f"{unit}/{time}" if power < 0 else f"{unit}*{time}" if unit else time
