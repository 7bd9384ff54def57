"""Parts of a result that are computed when they are first asked for."""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar


class FilledLater:
    """A result whose numbers for single samples may be left out until somebody wants them.

    A loaded result has a model and its covariance without its records; residuals need these. The fields that ``later``
    names must have no default but a factory, so that the class has no such attributes.
    """

    later: ClassVar[tuple[str, ...]] = ()

    def leave_out(self, fill: Callable[[], Mapping[str, Any]]) -> None:
        """Forget the fields of ``later``; the first of them that is asked for fills them all."""
        for name in self.later:
            self.__dict__.pop(name, None)
        self.__dict__["_fill"] = fill

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            fill = self.__dict__.get("_fill")
            if fill is None or name not in self.later:
                raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
            values = fill()
            self.__dict__.update({each: values[each] for each in self.later})
            return self.__dict__[name]
