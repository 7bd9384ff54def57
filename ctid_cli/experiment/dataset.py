"""Data sets: the record that estimators are given, and what is known besides."""

from __future__ import annotations

import dataclasses
import hashlib
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctid_cli.errors import DataError
from ctid_cli.models import AdditiveModel, DiscreteController, TransferFunction
from ctid_cli.signals import (
    Enters,
    Excitation,
    HeldSignal,
    Hold,
    InputFile,
    Loop,
    Noise,
    Record,
    Sampling,
    read_held_signal,
    read_record,
    regular_interval,
    stream,
)
from ctid_cli.signals.csv_file import Offset


@dataclass(frozen=True)
class LoopOptions:
    """What closes a loop around a system.

    Parameters
    ----------
    controller : DiscreteController
        Acts at every sample.
    reference : Excitation, optional
        Generates the reference of a simulated loop; that of a measured record is in its file.
    enters : {"controller", "input"}, default "controller"
        Whether the reference enters before the controller or behind it.
    """

    controller: DiscreteController
    reference: Excitation | None = None
    enters: Enters = "controller"


@dataclass(frozen=True, eq=False)
class DataSet:
    """A record and what is known of its origin.

    Parameters
    ----------
    record : Record
        What estimators are given.
    true_model : TransferFunction or AdditiveModel, optional
        The system, where it was simulated.
    validation : Record, optional
        The whole measured record with the samples of ``record`` masked: the input is there from the beginning, so
        that a model simulated from rest arrives at the remaining samples in the right state.
    """

    record: Record
    true_model: TransferFunction | AdditiveModel | None = None
    validation: Record | None = None


@dataclass(frozen=True, eq=False)
class SimulatedSource:
    """Data sets from a simulated system.

    Parameters
    ----------
    system : TransferFunction or AdditiveModel
        The system.
    excitation : Excitation or None
        Generates the input; None in a loop, which makes it.
    sampling : Sampling
        Generates the instants, and says what the estimator is told of the input.
    noise : Noise or None
        Generates what is added to the output.
    seed : int
        Seed of the experiment.
    input_sha256 : str, optional
        Content of the file of an excitation or reference that reads one.
    loop : LoopOptions, optional
        What closes a loop around the system, with a reference; None for an open loop.
    """

    system: TransferFunction | AdditiveModel
    excitation: Excitation | None
    sampling: Sampling
    noise: Noise | None
    seed: int
    input_sha256: str | None = None
    loop: LoopOptions | None = None

    def dataset(self, replicate: int) -> DataSet:
        """One realisation.

        Parameters
        ----------
        replicate : int
            Which one, from 0.

        Returns
        -------
        DataSet
            The same for the same arguments, whenever and wherever it is made.

        Raises
        ------
        DataError
            If the options make no usable record, or the file of the excitation is not the one that was planned.
        """
        generator = self.excitation if self.loop is None else self.loop.reference
        if isinstance(generator, InputFile) and self.input_sha256 is not None:
            require_content(generator.file, self.input_sha256)
        assert generator is not None
        times = self.sampling.times(stream(self.seed, "sampling", replicate))
        applied = generator.generate(times, stream(self.seed, "input", replicate))
        if self.loop is not None:
            return DataSet(self._record_in(self.loop, times, applied.at(times), replicate), true_model=self.system)
        output = self._simulated(applied, times)
        known = applied
        if self.sampling.input_record == "sampled":
            known = HeldSignal(times, applied.at(times), applied.hold)
        record = Record(times, output + self._drawn(output, replicate), known, noise_free=output)
        return DataSet(record, true_model=self.system)

    def _simulated(self, applied: HeldSignal, times: NDArray[np.float64]) -> NDArray[np.float64]:
        from ctid_cli.filtering import simulate, simulate_additive

        if isinstance(self.system, AdditiveModel):
            return simulate_additive(self.system, applied, times)
        return simulate(self.system, applied, times)

    def _record_in(
        self, loop: LoopOptions, times: NDArray[np.float64], reference: NDArray[np.float64], replicate: int
    ) -> Record:
        from ctid_cli.filtering import simulate_loop

        interval = regular_interval(times)
        if interval is None:
            raise DataError("a closed loop needs a regular clock, since its controller acts at every sample")
        # The noise comes before the output, because the output answers to it.
        noise = self._drawn(np.zeros(times.size), replicate)
        u, x = simulate_loop(self.system, loop.controller, reference, noise, interval, loop.enters)
        closed = Loop(reference, loop.controller, loop.enters)
        return Record(times, x + noise, HeldSignal(times, u), noise_free=x, loop=closed)

    def _drawn(self, output: NDArray[np.float64], replicate: int) -> NDArray[np.float64]:
        if self.noise is None:
            return np.zeros(output.size)
        return self.noise.generate(output, stream(self.seed, "noise", replicate))


@dataclass(frozen=True, eq=False)
class MeasuredSource:
    """The data set of a measured record.

    Parameters
    ----------
    file : str
        Comma-separated file.
    sha256 : str
        Its content.
    time, input, output : str
        Columns of the instants [s], the input [input unit] and the output [output unit].
    hold : {"zoh", "foh"}
        How the input behaves between its samples.
    offset : {"none", "remove"}
        Whether the means of the samples used for estimation are subtracted.
    estimation_samples : int, optional
        Identify on the first so many samples and judge on the rest; None identifies on all.
    reference : str, optional
        Column of the reference of the loop that the record was taken in.
    loop : LoopOptions, optional
        What closed that loop; the record has no loop unless both are given.
    """

    file: str
    sha256: str
    time: str = "t"
    input: str = "u"
    output: str = "y"
    hold: Hold = "zoh"
    offset: Offset = "none"
    estimation_samples: int | None = None
    reference: str | None = None
    loop: LoopOptions | None = None

    def dataset(self, replicate: int) -> DataSet:
        """The record.

        Parameters
        ----------
        replicate : int
            Only 0: a measured record is what it is.

        Returns
        -------
        DataSet
            Record for estimation and, where the file was split, for validation.

        Raises
        ------
        DataError
            If the file cannot be used, is not the one that was planned, or its input never changes.
        """
        if replicate != 0:
            raise ValueError(f"a measured record has replicate 0 only, not {replicate}")
        require_content(self.file, self.sha256)
        whole = read_record(self.file, time=self.time, input=self.input, output=self.output, hold=self.hold)
        t, u, y = whole.t, whole.input.values, whole.y
        count = t.size if self.estimation_samples is None else self.estimation_samples
        if count > t.size:
            raise DataError(f"{self.file}: {count} samples are asked for and the file has {t.size}")
        if not np.isfinite(y[:count]).any():
            raise DataError(f"{self.file}: none of the {count} output samples used for estimation is a finite number")
        if np.ptp(u[:count]) == 0.0:
            raise DataError(
                f"{self.file}: the input {self.input!r} is constant ({u[0]:g}) over the {count} samples used for "
                "estimation; it excites nothing to identify"
            )
        r = self._reference()
        if self.offset == "remove":
            # The remaining samples must not have a say in what the model is made of.
            u = u - u[:count].mean()
            y = y - np.nanmean(y[:count])
            r = None if r is None else r - r[:count].mean()
        # Without its folder: what an estimator says about the record is part of the results.
        name = Path(self.file).name
        loop = None
        if r is not None and self.loop is not None:
            loop = Loop(r[:count], self.loop.controller, self.loop.enters)
        record = Record(t[:count], y[:count], HeldSignal(t[:count], u[:count], self.hold), name=name, loop=loop)
        if count == t.size:
            return DataSet(record)
        rest = np.where(np.arange(t.size) < count, np.nan, y)
        if not np.isfinite(rest).any():
            return DataSet(record)
        return DataSet(record, validation=Record(t, rest, HeldSignal(t, u, self.hold), name=name))

    def _reference(self) -> NDArray[np.float64] | None:
        if self.reference is None:
            return None
        return read_held_signal(self.file, time=self.time, input=self.reference).values


Source = SimulatedSource | MeasuredSource


def joined(folder: Path, file: str) -> str:
    """Name of a file as seen from the working directory.

    Parameters
    ----------
    folder : Path
        Folder that the name is relative to.
    file : str
        Name as it stands in the specification.

    Returns
    -------
    str
        With slashes, without detours.
    """
    return Path(os.path.normpath(folder / file)).as_posix()


def located(options: Any, folder: Path) -> Any:
    """An excitation with the name of its file, if it reads one, as seen from the working directory.

    Parameters
    ----------
    options : Any
        Option dataclass of an excitation.
    folder : Path
        Folder that the name of the file is relative to.

    Returns
    -------
    Any
        The same, or a copy.
    """
    if not isinstance(options, InputFile):
        return options
    return dataclasses.replace(options, file=joined(folder, options.file))


def file_sha256(path: str) -> str:
    """Content hash of a file.

    Parameters
    ----------
    path : str
        The file.

    Returns
    -------
    str
        SHA-256 in hexadecimal.

    Raises
    ------
    DataError
        If the file is missing or cannot be read.
    """
    try:
        return hashlib.sha256(Path(path).read_bytes()).hexdigest()
    except FileNotFoundError:
        message = f"{path}: there is no such file; names are relative to the folder of the specification"
        raise DataError(message) from None
    except OSError as error:
        raise DataError(f"{path}: the file cannot be read: {error.strerror or error}") from None


def require_content(path: str, sha256: str) -> None:
    """Refuse a file that is not the one that an experiment was planned with.

    Parameters
    ----------
    path : str
        The file.
    sha256 : str
        What its content hash must be.

    Raises
    ------
    DataError
        If the content is another one.
    """
    found = file_sha256(path)
    if found != sha256:
        raise DataError(
            f"{path}: the content (SHA-256 {found[:12]}…) is not that which the experiment was planned with "
            f"({sha256[:12]}…); restore the file, or run the changed one as an experiment of its own"
        )


def check_input_file(options: Any) -> None:
    """Refuse the file of an excitation if it cannot be read.

    Parameters
    ----------
    options : InputFile
        Names the file and its columns.

    Raises
    ------
    DataError
        If the file cannot be used.
    """
    read_held_signal(options.file, time=options.time, input=options.input, hold=options.hold)
