"""Data sets: the record that estimators are given, and what is known besides."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ctid_cli.errors import DataError
from ctid_cli.models import TransferFunction
from ctid_cli.signals import (
    Excitation,
    HeldSignal,
    Hold,
    InputFile,
    Noise,
    Record,
    Sampling,
    read_held_signal,
    read_record,
    stream,
)
from ctid_cli.signals.csv_file import Offset


@dataclass(frozen=True, eq=False)
class DataSet:
    """A record and what is known of its origin.

    Parameters
    ----------
    record : Record
        What estimators are given.
    true_model : TransferFunction, optional
        The system, where it was simulated.
    validation : Record, optional
        The whole measured record with the samples of ``record`` masked: the input is there from the beginning, so
        that a model simulated from rest arrives at the remaining samples in the right state.
    """

    record: Record
    true_model: TransferFunction | None = None
    validation: Record | None = None


@dataclass(frozen=True, eq=False)
class SimulatedSource:
    """Data sets from a simulated system.

    Parameters
    ----------
    system : TransferFunction
        The system.
    excitation : Excitation
        Generates the input.
    sampling : Sampling
        Generates the instants, and says what the estimator is told of the input.
    noise : Noise or None
        Generates what is added to the output.
    seed : int
        Seed of the experiment.
    input_sha256 : str, optional
        Content of the file of an excitation that reads one.
    """

    system: TransferFunction
    excitation: Excitation
    sampling: Sampling
    noise: Noise | None
    seed: int
    input_sha256: str | None = None

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
        from ctid_cli.filtering import simulate

        if isinstance(self.excitation, InputFile) and self.input_sha256 is not None:
            require_content(self.excitation.file, self.input_sha256)
        times = self.sampling.times(stream(self.seed, "sampling", replicate))
        applied = self.excitation.generate(times, stream(self.seed, "input", replicate))
        output = simulate(self.system, applied, times)
        noise = 0.0 if self.noise is None else self.noise.generate(output, stream(self.seed, "noise", replicate))
        known = applied
        if self.sampling.input_record == "sampled":
            known = HeldSignal(times, applied.at(times), applied.hold)
        return DataSet(Record(times, output + noise, known, noise_free=output), true_model=self.system)


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
    """

    file: str
    sha256: str
    time: str = "t"
    input: str = "u"
    output: str = "y"
    hold: Hold = "zoh"
    offset: Offset = "none"
    estimation_samples: int | None = None

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
        if self.offset == "remove":
            # The remaining samples must not have a say in what the model is made of.
            u = u - u[:count].mean()
            y = y - np.nanmean(y[:count])
        # Without its folder: what an estimator says about the record is part of the results.
        name = Path(self.file).name
        record = Record(t[:count], y[:count], HeldSignal(t[:count], u[:count], self.hold), name=name)
        if count == t.size:
            return DataSet(record)
        rest = np.where(np.arange(t.size) < count, np.nan, y)
        if not np.isfinite(rest).any():
            return DataSet(record)
        return DataSet(record, validation=Record(t, rest, HeldSignal(t, u, self.hold), name=name))


Source = SimulatedSource | MeasuredSource


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
