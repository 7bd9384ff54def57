"""Records, held signals, excitations, sampling schemes and noise."""

from ctid_cli.signals.csv_file import read_held_signal, read_record
from ctid_cli.signals.excitation import (
    EXCITATIONS,
    TAPS,
    Excitation,
    Gaussian,
    InputFile,
    Multisine,
    Prbs,
    Step,
    maximal_length_sequence,
)
from ctid_cli.signals.held import COINCIDENCE, HeldSignal, Hold
from ctid_cli.signals.measurement import Measurement, read_measurement
from ctid_cli.signals.noise import NOISES, Noise, WhiteNoise
from ctid_cli.signals.record import Record, regular_interval
from ctid_cli.signals.sampling import SAMPLINGS, InputRecord, RegularSampling, Sampling, UniformIntervals
from ctid_cli.signals.streams import ROLES, Role, stream

__all__ = [
    "COINCIDENCE",
    "EXCITATIONS",
    "NOISES",
    "ROLES",
    "SAMPLINGS",
    "TAPS",
    "Excitation",
    "Gaussian",
    "HeldSignal",
    "Hold",
    "InputFile",
    "InputRecord",
    "Measurement",
    "Multisine",
    "Noise",
    "Prbs",
    "Record",
    "RegularSampling",
    "Role",
    "Sampling",
    "Step",
    "UniformIntervals",
    "WhiteNoise",
    "maximal_length_sequence",
    "read_held_signal",
    "read_measurement",
    "read_record",
    "regular_interval",
    "stream",
]
