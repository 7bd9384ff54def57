"""Parameters that are known, by their names."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from ctid_cli.errors import OptionError
from ctid_cli.signals.checks import require_finite
from ctid_cli.text import listed


@dataclass(frozen=True)
class Fixed:
    """A parameter that is known.

    Parameters
    ----------
    name : str
        Its name in the table of parameters, for example a1 or g1_b0.
    value : float
        Its value, in the unit of that table.

    Raises
    ------
    ValueError
        If the value is not a finite number.
    """

    name: str
    value: float

    def __post_init__(self) -> None:
        require_finite("value", self.value, "unit of the parameter", label=f"the value of {self.name}")


def places_of(fixed: Iterable[Fixed] | None, names: Sequence[str]) -> dict[int, float]:
    """Values of known parameters by their places among the names; unknown names and repetitions are refused."""
    found: dict[int, float] = {}
    for one in fixed or ():
        if one.name == "delay":
            raise OptionError("fixed", "the delay is no parameter to fix: a known delay is given as such")
        if one.name not in names:
            raise OptionError("fixed", f"there is no parameter {one.name!r} to fix; there are {listed(names)}")
        place = names.index(one.name)
        if place in found:
            raise OptionError("fixed", f"parameter {one.name} is fixed twice")
        found[place] = float(one.value)
    if len(found) == len(names):
        raise OptionError("fixed", "every parameter is fixed, so that there is nothing to estimate")
    return found
