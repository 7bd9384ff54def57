"""The section for where estimators start: at an initial delay, or at initial parameters."""

from collections.abc import Iterator, Mapping
from typing import Annotated, Any

from pydantic import AfterValidator, Field

from ctid_cli.specification.fields import LATER, ByShape, NotNegative, OneOf, without_copies
from ctid_cli.specification.messages import Complaint
from ctid_cli.specification.sections import Section
from ctid_cli.specification.system_sections import AdditiveSection


class UniformStart(Section):
    """An initial delay drawn anew for every data set.

    Parameters
    ----------
    uniform : list of float
        least and greatest value [s]
    """

    uniform: Annotated[list[NotNegative], Field(min_length=2, max_length=2)]

    def complaints(self) -> Iterator[Complaint]:
        """Say why the range is none."""
        low, high = self.uniform
        if not low < high:
            yield ("uniform",), f"the first value, {low:g} s, must be below the second, {high:g} s"


class RelativeStart(Section):
    """Initial parameters drawn anew for every data set, around those of the simulated system.

    Parameters
    ----------
    relative_uniform : float
        Every parameter is multiplied by a random number from 1 - this to 1 + this [-]
    """

    # Below 1 parameters keep their sign.
    relative_uniform: float = Field(gt=0.0, lt=1.0, allow_inf_nan=False)


class GivenStart(AdditiveSection):
    """Initial parameters as a sum of submodels."""


def _form(value: Any) -> str | None:
    given = value if isinstance(value, Mapping) else ()
    found = [name for name, form in _FORMS.items() if isinstance(value, form) or name in given]
    return found[0] if len(found) == 1 else None


def _several(one: OneOf) -> ByShape:
    """A start or a list of different ones."""
    item = Annotated[Any, one]
    return ByShape(item, list=Annotated[list[item], Field(min_length=1), AfterValidator(without_copies)])


_DELAYS = _several(ByShape(NotNegative, "{uniform: [low, high]} is allowed too", mapping=UniformStart))
_FORMS = {"relative_uniform": RelativeStart, "additive": GivenStart}
_PARAMETERS = _several(OneOf(_form, _FORMS, "no_form", "{relative_uniform: fraction} or {additive: [submodels]}"))
_LISTED = AfterValidator(lambda value: value if isinstance(value, list) else [value])


class StartsSection(Section):
    """Where estimators start that need, or take, an initial delay or initial parameters.

    Parameters
    ----------
    initial_delay : float, mapping or list of these, optional
        Initial delays [s]; {uniform: [low, high]} draws one for every data set
    parameters : mapping or list of mappings, optional
        Initial parameters, drawn around those of the simulated system or given; by default every estimator makes its
        own
    """

    if_empty = "give initial_delay, parameters or both, or leave the section out"

    initial_delay: Annotated[list[float | UniformStart], _DELAYS, _LISTED] | None = None
    parameters: Annotated[Annotated[list[RelativeStart | GivenStart], _PARAMETERS, _LISTED] | None, LATER] = None
