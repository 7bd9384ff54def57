"""The errors that a user can meet, each with the exit code that the command line answers with."""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum

#: Problems of a specification that a message lists.
MAX_SHOWN = 100


class ExitCode(IntEnum):
    """What a command ends with."""

    DONE = 0
    INTERNAL = 1
    BAD_INPUT = 2
    REFUSED = 3
    ALL_FAILED = 4
    STOPPED = 5
    STORAGE = 6
    DIFFERENCE = 7
    MACHINE = 8
    INTERRUPTED = 130
    TERMINATED = 143


class CtidError(Exception):
    """Base of every error that ctid raises on purpose; its text is meant for the user."""

    exit_code = ExitCode.INTERNAL


class UsageError(CtidError):
    """The request itself cannot be carried out: a bad option, specification or record."""

    exit_code = ExitCode.BAD_INPUT


class DataError(UsageError):
    """A record (times, input, output) or model that cannot be used, and why.

    Parameters
    ----------
    message : str
        What is wrong.
    field : str, default ""
        Argument at fault, where it is a single one.
    """

    def __init__(self, message: str, field: str = "") -> None:
        super().__init__(message)
        self.field = field
        #: Place in a specification of what is at fault, where that came up in a simulation.
        self.section = ""


class BiasedError(DataError):
    """An estimator that settles elsewhere than at the truth, however many the data; the text is the reason."""


class OptionError(ValueError):
    """An option that has no allowed value."""

    def __init__(self, field: str, message: str) -> None:
        super().__init__(message)
        #: Name of the option.
        self.field = field


@dataclass(frozen=True)
class Problem:
    """One thing wrong in a specification, with its place in the file."""

    file: str
    line: int
    column: int
    key: str
    message: str

    def __str__(self) -> str:
        key = f"{self.key}: " if self.key else ""
        return f"{self.file}:{self.line}:{self.column}: {key}{self.message}"


class SpecError(UsageError):
    """A specification with one or more problems, all of them reported at once.

    Parameters
    ----------
    problems : iterable of Problem
        What is wrong, in the order of the file.
    """

    def __init__(self, problems: Iterable[Problem]) -> None:
        self.problems = tuple(problems)
        lines = [str(problem) for problem in self.problems[:MAX_SHOWN]]
        more = len(self.problems) - len(lines)
        super().__init__("\n".join([*lines, *([f"and {more} more problems like these"] if more else [])]))


class RefusedError(CtidError):
    """The folder holds something that this command must not touch or mix with."""

    exit_code = ExitCode.REFUSED


class TooManyFailuresError(CtidError):
    """The run finished, but more estimates failed than the user accepts."""

    exit_code = ExitCode.ALL_FAILED


class StorageError(CtidError):
    """Results could not be written or read back; what was finished before is safe."""

    exit_code = ExitCode.STORAGE


class DamageError(StorageError):
    """A stored file is not what was written."""


class MismatchError(CtidError):
    """A comparison or verification found a difference."""

    exit_code = ExitCode.DIFFERENCE


class MachineError(CtidError):
    """The machine did not let estimates finish (memory, descriptors, killed processes); they are not stored."""

    exit_code = ExitCode.MACHINE
