"""A measured record with the loop that it was taken in."""

from dataclasses import replace

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError
from ctid_cli.models.controller import ContinuousController, DiscreteController, Relay
from ctid_cli.signals.measurement import Measurement
from ctid_cli.signals.record import Loop, Record
from ctid_cli.signals.table import split_header
from ctid_cli.simulation.dataset import LoopOptions

#: Share of the moves of the input [-] that the controller may leave unexplained: what rounding in a file does.
UNEXPLAINED = 0.05


def in_loop(measured: Measurement, loop: LoopOptions) -> Measurement:
    """Return the measurement with its reference and controller; a DataError says why they are not those of it."""
    record, r = measured.record, measured.reference_values
    assert r is not None
    _check_units(measured, loop)
    why, controller = "", loop.at(record.interval or 1.0).controller
    if isinstance(controller, ContinuousController):
        if record.input.hold == "band-limited":
            raise DataError(f"{record.name}: the reference between its samples must be held: --hold zoh or foh")
        # Between its samples the input is not known, and it is not needed.
        own = Loop(r, controller, loop.enters, record.input.hold)
        return replace(measured, record=replace(record, loop=own))
    if isinstance(controller, Relay):
        why = "closed-loop instruments need a linear controller, no relay"
    elif record.input.hold != "zoh":
        why = "a discrete controller holds its input (--hold zoh)"
    elif record.interval is None:
        why = "the controller acts at every sample of a regular clock, and that of this record is irregular"
    elif not (left := unexplained(record, r, controller, loop.enters)) <= UNEXPLAINED:
        share = f"{100 * min(left, 1.0):.3g} %"
        made = "C(q) (r - y)" if loop.enters == "controller" else "r - C(q) y"
        why = (
            f"the input is not what the controller makes, u = {made}: {share} of its moves differ; a "
            "controller with two degrees of freedom or in continuous time, another sampling interval, sign or "
            "reference, or limits of the actuator do that, and estimates with it would be wrong"
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
            f"{record.name}: the reference as an instrument needs a regular clock, and that of this record is "
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
    # From the first instant on at which all samples of the polynomials are there.
    moves, made = np.convolve(own, a, "valid"), np.convolve(driven, b, "valid")
    left = moves - made
    present = np.isfinite(left)
    scale = float(np.mean(moves[present] ** 2)) if present.any() else 0.0
    return float(np.sqrt(np.mean(left[present] ** 2) / scale)) if scale > 0 else float("inf")


def _check_units(measured: Measurement, loop: LoopOptions) -> None:
    """Refuse a reference in another unit than the signal that it is compared with."""
    assert measured.reference is not None
    unit = split_header(measured.reference)[1]
    what = "output" if loop.enters == "controller" else "input"
    other = measured.output_unit if loop.enters == "controller" else measured.input_unit
    if unit is not None and other is not None and unit != other:
        column = f"the reference {measured.reference!r} is in {unit}, and the {what} that it enters with in {other}"
        raise DataError(f"{measured.record.name}: {column}; name another column, or say where it enters (loop.enters)")
