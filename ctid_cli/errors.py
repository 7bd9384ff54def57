"""Errors for the user, each with the exit code of the command line."""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum

#: Maximum number of specification problems listed in a message.
MAX_SHOWN = 100


class ExitCode(IntEnum):
    """Exit code of a command."""

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
    """Base of all intentional errors of ctid; the text is written for the user."""

    exit_code = ExitCode.INTERNAL


class UsageError(CtidError):
    """A request that cannot be carried out: invalid option, specification or record."""

    exit_code = ExitCode.BAD_INPUT


class DataError(UsageError):
    """A record (times, input, output) or model that cannot be used.

    Parameters
    ----------
    message : str
        What is wrong.
    field : str, default ""
        Argument at fault, if it is a single one.
    """

    def __init__(self, message: str, field: str = "") -> None:
        super().__init__(message)
        self.field = field
        #: Section of the specification at fault, for errors during a simulation.
        self.section = ""


class BiasedError(DataError):
    """An inconsistent estimator: its error does not vanish with the number of samples; the text is the reason."""


class OptionError(ValueError):
    """An invalid value of an option."""

    def __init__(self, field: str, message: str) -> None:
        super().__init__(message)
        #: Name of the option.
        self.field = field


@dataclass(frozen=True)
class Problem:
    """One error in a specification, with its place in the file."""

    file: str
    line: int
    column: int
    key: str
    message: str

    def __str__(self) -> str:
        key = f"{self.key}: " if self.key else ""
        return f"{self.file}:{self.line}:{self.column}: {key}{self.message}"


class SpecError(UsageError):
    """A specification with one or more problems, all reported at once.

    Parameters
    ----------
    problems : iterable of Problem
        The problems in the order of the file.
    """

    def __init__(self, problems: Iterable[Problem]) -> None:
        self.problems = tuple(problems)
        lines = [str(problem) for problem in self.problems[:MAX_SHOWN]]
        more = len(self.problems) - len(lines)
        super().__init__("\n".join([*lines, *([f"and {more} more problems like these"] if more else [])]))


class RefusedError(CtidError):
    """A folder whose content this command must not change or mix with."""

    exit_code = ExitCode.REFUSED


class TooManyFailuresError(CtidError):
    """A finished run in which more estimates failed than the user accepts."""

    exit_code = ExitCode.ALL_FAILED


class StorageError(CtidError):
    """Results that could not be written or read; results finished before are safe."""

    exit_code = ExitCode.STORAGE


class DamageError(StorageError):
    """A stored file whose content differs from what was written."""


class MismatchError(CtidError):
    """A difference found by a comparison or verification."""

    exit_code = ExitCode.DIFFERENCE


class MachineError(CtidError):
    """A lack of machine resources (memory, descriptors, killed processes); affected estimates are not stored."""

    exit_code = ExitCode.MACHINE
