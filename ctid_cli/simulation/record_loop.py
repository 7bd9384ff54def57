"""Attachment of a feedback loop to a measured record."""

from dataclasses import replace

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError
from ctid_cli.models.controller import ContinuousController, DiscreteController, Relay
from ctid_cli.signals.measurement import Measurement
from ctid_cli.signals.record import Loop, Record
from ctid_cli.signals.table import split_header
from ctid_cli.simulation.dataset import LoopOptions

#: Largest allowed relative RMS error of the input computed by the controller [-]; rounding in files causes such errors.
UNEXPLAINED = 0.05


def in_loop(measured: Measurement, loop: LoopOptions) -> Measurement:
    """Return the measurement with its reference and controller; raise a DataError if the input contradicts them."""
    record, r = measured.record, measured.reference_values
    assert r is not None
    _check_units(measured, loop)
    why, controller = "", loop.at(record.interval or 1.0).controller
    if isinstance(controller, ContinuousController):
        if record.input.hold == "band-limited":
            raise DataError(f"{record.name}: the reference between its samples must be held: --hold zoh or foh")
        # The input between its samples is unknown and not needed.
        own = Loop(r, controller, loop.enters, record.input.hold)
        return replace(measured, record=replace(record, loop=own))
    if isinstance(controller, Relay):
        why = "closed-loop instruments need a linear controller, not a relay"
    elif record.input.hold != "zoh":
        why = "a discrete controller holds its input (--hold zoh)"
    elif record.interval is None:
        why = "a discrete controller needs a regular clock, and the clock of this record is irregular"
    elif not (left := unexplained(record, r, controller, loop.enters)) <= UNEXPLAINED:
        share = f"{100 * min(left, 1.0):.3g} %"
        made = "C(q) (r - y)" if loop.enters == "controller" else "r - C(q) y"
        why = (
            f"the input does not follow from the controller, u = {made}: the error is {share} of its changes; possible "
            "causes are a controller with two degrees of freedom or in continuous time, another sampling interval, "
            "sign or reference, or actuator limits; estimates with this controller would be wrong"
        )
    if why:
        cure = "correct --loop or --reference, or give --loop unknown, which needs no controller"
        if record.interval is None:
            cure = "give a controller in continuous time, or --loop unknown without --reference (the direct method)"
        raise DataError(f"{record.name}: {why}; {cure}")
    closed = Record(record.t, record.y, record.input, name=record.name, loop=Loop(r, controller, loop.enters))
    return replace(measured, record=closed)


def in_unknown_loop(measured: Measurement) -> Measurement:
    """Return the measurement with its reference, in a loop whose controller is not known."""
    record, r = measured.record, measured.reference_values
    assert r is not None
    if record.interval is None:
        raise DataError(
            f"{record.name}: the reference as an instrument needs a regular clock, and the clock of this record is "
            "irregular; give a controller in continuous time (--loop FILE), or leave --reference out"
        )
    return replace(measured, record=replace(record, loop=Loop(r, None)))


def unexplained(record: Record, r: Array, controller: DiscreteController, enters: str) -> float:
    """Return the root mean square of ``A u - B e`` relative to that of its terms; ``C = B/A``, any initial state."""
    a, b = controller.denominator, controller.numerator
    b = np.concatenate((np.zeros(a.size - b.size), b))
    at_controller = enters == "controller"
    u, driven = record.input.values, (r if at_controller else 0.0) - record.y
    own = u if at_controller else u - r
    # From the first instant at which all delayed samples exist.
    moves, made = np.convolve(own, a, "valid"), np.convolve(driven, b, "valid")
    left = moves - made
    present = np.isfinite(left)
    scale = float(np.mean(moves[present] ** 2)) if present.any() else 0.0
    return float(np.sqrt(np.mean(left[present] ** 2) / scale)) if scale > 0 else float("inf")


def _check_units(measured: Measurement, loop: LoopOptions) -> None:
    """Raise an error if the unit of the reference differs from that of the signal that it is added to."""
    assert measured.reference is not None
    unit = split_header(measured.reference)[1]
    what = "output" if loop.enters == "controller" else "input"
    other = measured.output_unit if loop.enters == "controller" else measured.input_unit
    if unit is not None and other is not None and unit != other:
        column = f"the reference {measured.reference!r} is in {unit}, but the {what} is in {other}"
        raise DataError(f"{measured.record.name}: {column}; choose another column or loop.enters")
