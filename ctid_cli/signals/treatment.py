"""Names of signal treatments, shared by commands, specifications and options.

They are in a separate module because the command line starts with them and without NumPy.
"""

from typing import Literal

#: Input between its samples: held, straight lines, or without power above half the sampling frequency.
Hold = Literal["zoh", "foh", "band-limited"]
#: Hold, or ``auto`` for the one that describes a record best.
AskedHold = Literal["auto", "zoh", "foh", "band-limited"]
#: Hold of all inputs, or of each.
Holds = Hold | tuple[Hold, ...]
#: Method of estimating a frequency response.
ResponseMethod = Literal["auto", "periodic", "local-polynomial", "welch"]
#: Interpolation of the output samples in an estimator's filters.
OutputHold = Literal["zoh", "foh"]
#: State of the system before the record.
InitialState = Literal["rest", "estimate", "periodic"]
#: Constant, or constant and slope, of the output in addition to the response to the input.
Offset = Literal["none", "remove", "estimate", "drift"]
#: Constant input before the first sample of a record that begins at rest [input unit]: a value, the first one of
#: the record, or None for zero.
InputBefore = float | Literal["first"] | None
#: Factor of the errors of a frequency response without standard errors: the reciprocal of the measured gain, of
#: its square root, or one.
Weight = Literal["inverse", "inverse-sqrt", "none"]
#: Loss of the output errors: squares, or less than squares for large errors.
LossKind = Literal["squares", "huber", "tukey"]
