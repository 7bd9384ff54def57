"""Words for how the signals of a record are treated, shared by commands, specifications and options.

They have a file of their own because the command line starts with them and without NumPy.
"""

from typing import Literal

#: The input between its samples: held, straight lines, or without power above half the sampling frequency.
Hold = Literal["zoh", "foh", "band-limited"]
#: The same, or whichever describes a record best.
AskedHold = Literal["auto", "zoh", "foh", "band-limited"]
#: The hold of all inputs, or that of each.
Holds = Hold | tuple[Hold, ...]
#: How a frequency response is estimated.
ResponseMethod = Literal["auto", "periodic", "local-polynomial", "welch"]
#: How an estimator's filters join the samples of the output.
OutputHold = Literal["zoh", "foh"]
#: The state of the system before the record.
InitialState = Literal["rest", "estimate", "periodic"]
#: A constant, or a constant and a slope, that the output has beside the response to the input.
Offset = Literal["none", "remove", "estimate", "drift"]
#: The constant input before the first sample of a record that begins at rest [input unit]: a value, the first one of
#: the record, or None for zero.
InputBefore = float | Literal["first"] | None
#: What multiplies the errors of a frequency response without standard errors: the reciprocal of the measured gain, of
#: its square root, or one.
Weight = Literal["inverse", "inverse-sqrt", "none"]
#: What output errors count: their squares, or less where they are large.
LossKind = Literal["squares", "huber", "tukey"]
