"""The test signals of the standard, from their formulas, with the true phasor, frequency and rate of change."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from ctid_cli.arrays import Array, ComplexArray
from ctid_cli.frequency.synchrophasor_filters import PerformanceClass, frequency_range
from ctid_cli.frequency.synchrophasor_limits import modulation_range

#: Depth of the modulation: of the amplitude, and of the phase [rad].
DEPTH = 0.1
#: Height of the steps: of the amplitude, and of the phase [rad].
STEPS = {"magnitude_step": 0.1, "phase_step": math.pi / 18.0}
#: Slope of the ramps [Hz/s].
RAMP = 1.0
#: Highest harmonic.
HARMONICS = 50
#: Lowest frequency of an interference [Hz]; the highest is twice the nominal frequency.
LOWEST_INTERFERENCE = 10.0
#: So far from the band of the reporting rate interferences are tried at every hertz [Hz].
CLOSE_INTERFERENCE = 12.0

_Course = Callable[[Array], Array]


def _constant(value: float) -> _Course:
    return lambda t: np.full(t.shape, value)


def _straight(slope: float, begin: float) -> _Course:
    return lambda t: np.asarray(slope * t + begin)


def _wave(height: float, w: float, phase: float = 0.0) -> _Course:
    return lambda t: np.asarray(height * np.cos(w * t + phase))


def _switch(before: float, height: float) -> _Course:
    return lambda t: np.where(t >= 0.0, before + height, before)


_nothing = _constant(0.0)


@dataclass(frozen=True)
class TestSignal:
    """A tone ``(1 + amplitude(t)) cos(2 pi f0 t + angle(t))`` and what disturbs it."""

    __test__ = False

    #: Condition of the test, in words.
    condition: str
    nominal: int
    #: Relative change of the amplitude.
    amplitude: _Course = _nothing
    #: Phase against the nominal frequency [rad], its slope [Hz], and the slope's [Hz/s].
    angle: _Course = _nothing
    deviation: _Course = _nothing
    rocof: _Course = _nothing
    #: What is added and is no part of the phasor.
    disturbance: _Course = _nothing
    #: Period of what is slowest in it [s], over which the errors are looked at.
    period: float = 0.0

    def samples(self, t: Array) -> Array:
        """The signal."""
        tone = (1.0 + self.amplitude(t)) * np.cos(2.0 * np.pi * self.nominal * t + self.angle(t))
        return np.asarray(tone + self.disturbance(t))

    def phasor(self, t: Array) -> ComplexArray:
        """The true synchrophasor: root mean square, and phase against a cosine of the nominal frequency."""
        return np.asarray((1.0 + self.amplitude(t)) * np.exp(1j * self.angle(t)) / math.sqrt(2.0))


def off_nominal(nominal: int, by: float) -> TestSignal:
    """A tone whose frequency is off by so many hertz."""
    return TestSignal(
        f"{nominal + by:.4g} Hz",
        nominal,
        angle=_straight(2.0 * np.pi * by, 0.0),
        deviation=_constant(by),
        period=1.0 / abs(by) if by else 0.0,
    )


def steady_frequencies(nominal: int, kind: PerformanceClass, rate: int) -> Iterator[TestSignal]:
    """Tones over the range of the class, every 0.1 Hz."""
    furthest = frequency_range(kind, rate)
    count = round(furthest / 0.1)
    for by in np.linspace(-furthest, furthest, 2 * count + 1):
        yield off_nominal(nominal, float(by))


def magnitudes(nominal: int) -> Iterator[TestSignal]:
    """Tones of 80 or 10 to 120 % of the rated voltage, and 10 to 200 % of the rated current."""
    for size in (0.1, 0.2, 0.5, 0.8, 1.0, 1.2, 1.5, 2.0):
        yield TestSignal(f"{100 * size:g} %", nominal, amplitude=_constant(size - 1.0))


def harmonic_distortions(nominal: int, kind: PerformanceClass, sampling_rate: float) -> Iterator[TestSignal]:
    """One harmonic at a time, 1 % or 10 % high, up to the 50th or to where sampling would fold it."""
    height = 0.01 if kind == "P" else 0.1
    for order in range(2, HARMONICS + 1):
        if order * nominal >= 0.5 * sampling_rate:
            return
        yield TestSignal(
            f"harmonic {order}",
            nominal,
            disturbance=_wave(height, 2.0 * np.pi * order * nominal),
        )


def interferences(nominal: int, rate: int) -> Iterator[TestSignal]:
    """Tones of 10 % outside the band of the reporting rate, the signal at and beside its nominal frequency."""
    beside, edge = min(rate / 20.0, 5.0), 0.5 * rate
    candidates = np.unique(
        np.append(np.arange(LOWEST_INTERFERENCE, 2.0 * nominal + 0.5), (nominal - edge, nominal + edge))
    )
    away = np.abs(candidates - nominal)
    # Every hertz beside the band, every fifth further away.
    near = (away < edge + CLOSE_INTERFERENCE) | (candidates % 5.0 == 0.0)
    inside = (candidates >= LOWEST_INTERFERENCE) & (candidates <= 2.0 * nominal)
    for by in (-beside, 0.0, beside):
        for other in candidates[(away >= edge) & near & inside].tolist():
            base = off_nominal(nominal, by)
            yield TestSignal(
                f"{other:g} Hz beside {nominal + by:g} Hz",
                nominal,
                angle=base.angle,
                deviation=base.deviation,
                disturbance=_wave(0.1, 2.0 * np.pi * other),
                period=1.0 / abs(other - nominal - by),
            )


def modulations(nominal: int, kind: PerformanceClass, rate: int, test: str) -> Iterator[TestSignal]:
    """Modulation of the amplitude or of the phase, from 0.1 Hz on."""
    highest = modulation_range(kind, rate)
    for frequency in np.unique(np.append(np.arange(0.1, highest, 0.2), highest)).tolist():
        w, condition, period = 2.0 * np.pi * frequency, f"{frequency:.3g} Hz", 1.0 / frequency
        if test == "amplitude_modulation":
            yield TestSignal(condition, nominal, amplitude=_wave(DEPTH, w), period=period)
            continue
        yield TestSignal(
            condition,
            nominal,
            angle=_wave(DEPTH, w, -np.pi),
            deviation=_wave(DEPTH * frequency, w, -0.5 * np.pi),
            rocof=_wave(-DEPTH * w * frequency, w, -np.pi),
            period=period,
        )


def ramp(nominal: int, furthest: float, slope: float) -> TestSignal:
    """A frequency that runs from one end of its range at ``-furthest/RAMP`` s to the other, steady before and after."""
    sign, end = math.copysign(1.0, slope), furthest / abs(slope)

    def deviation(t: Array) -> Array:
        return np.asarray(slope * np.clip(t, -end, end))

    def angle(t: Array) -> Array:
        beyond = np.maximum(np.abs(t) - end, 0.0)
        inside = np.clip(t, -end, end)
        return np.asarray(2.0 * np.pi * (0.5 * slope * inside**2 + sign * furthest * beyond))

    def rocof(t: Array) -> Array:
        return np.where(np.abs(t) <= end, slope, 0.0)

    return TestSignal(f"{slope:+g} Hz/s", nominal, angle=angle, deviation=deviation, rocof=rocof, period=2.0 * end)


def step(nominal: int, test: str, sign: float, phase: float) -> TestSignal:
    """A step at time zero, at this phase of the tone."""
    height = sign * STEPS[test]
    if test == "magnitude_step":
        return TestSignal(f"{100.0 * height:+g} %", nominal, amplitude=_switch(0.0, height), angle=_constant(phase))
    return TestSignal(f"{math.degrees(height):+g} degrees", nominal, angle=_switch(phase, height))
