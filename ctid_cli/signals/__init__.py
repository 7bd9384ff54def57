"""Records, held signals, excitations, sums of sinusoids, sampling schemes and noise."""

from ctid_cli.signals.arma_noise import ArmaNoise
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
from ctid_cli.signals.multi_sine import (
    DISTURBANCES,
    Disturbance,
    MultiSine,
    Piece,
    SineDisturbance,
    Tone,
    UniformDisturbance,
    disturb,
)
from ctid_cli.signals.noise import NOISES, Noise, WhiteNoise
from ctid_cli.signals.record import Controller, Enters, Loop, Record, regular_interval
from ctid_cli.signals.sampling import (
    SAMPLINGS,
    InputRecord,
    RegularSampling,
    Sampling,
    UniformIntervals,
    geometric_sizes,
)
from ctid_cli.signals.streams import ROLES, Role, stream

__all__ = [
    "COINCIDENCE",
    "DISTURBANCES",
    "EXCITATIONS",
    "NOISES",
    "ROLES",
    "SAMPLINGS",
    "TAPS",
    "ArmaNoise",
    "Controller",
    "Disturbance",
    "Enters",
    "Excitation",
    "Gaussian",
    "HeldSignal",
    "Hold",
    "InputFile",
    "InputRecord",
    "Loop",
    "Measurement",
    "MultiSine",
    "Multisine",
    "Noise",
    "Piece",
    "Prbs",
    "Record",
    "RegularSampling",
    "Role",
    "Sampling",
    "SineDisturbance",
    "Step",
    "Tone",
    "UniformDisturbance",
    "UniformIntervals",
    "WhiteNoise",
    "disturb",
    "geometric_sizes",
    "maximal_length_sequence",
    "read_held_signal",
    "read_measurement",
    "read_record",
    "regular_interval",
    "stream",
]
