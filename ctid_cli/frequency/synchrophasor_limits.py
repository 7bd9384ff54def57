"""What the standard asks of a synchrophasor measurement: every limit, with where it is from.

Tables are those of IEEE C37.118.1-2011 as amended by IEEE C37.118.1a-2014; IEC/IEEE 60255-118-1:2018 took their limits
over.
"""

from collections.abc import Iterable
from dataclasses import dataclass

from ctid_cli.frequency.synchrophasor_filters import PerformanceClass

_FIRST, _AMENDED = "IEEE C37.118.1-2011", "IEEE C37.118.1a-2014"


@dataclass(frozen=True)
class Limit:
    """One limit of the standard.

    Parameters
    ----------
    test : str
        Test that it belongs to, such as ``"signal_frequency"``.
    quantity : str
        What is limited: ``"tve"``, the total vector error [%]; ``"fe"``, the frequency error [Hz]; ``"rfe"``, the error
        of the rate of change of frequency [Hz/s]; their response times ``"tve_response"``, ``"fe_response"`` and
        ``"rfe_response"`` [s]; ``"delay"`` [s], ``"overshoot"`` [% of the step], ``"latency"`` [s].
    largest : float or None
        Largest allowed value; None where the standard has none.
    source : str
        Where the standard says so.
    """

    test: str
    quantity: str
    largest: float | None
    source: str


#: The tests, in the order of the standard, with the words for them.
TESTS = {
    "signal_frequency": "signal frequency",
    "signal_magnitude": "signal magnitude",
    "phase_angle": "phase angle",
    "harmonic_distortion": "harmonic distortion",
    "out_of_band": "out-of-band interference",
    "amplitude_modulation": "amplitude modulation",
    "phase_modulation": "phase modulation",
    "frequency_ramp": "frequency ramp",
    "magnitude_step": "magnitude step",
    "phase_step": "phase step",
    "latency": "reporting latency",
}
#: The quantities with their units.
QUANTITIES = {
    "tve": ("total vector error", "%"),
    "fe": ("frequency error", "Hz"),
    "rfe": ("ROCOF error", "Hz/s"),
    "tve_response": ("response time of the phasor", "s"),
    "fe_response": ("response time of the frequency", "s"),
    "rfe_response": ("response time of ROCOF", "s"),
    "delay": ("delay time", "s"),
    "overshoot": ("overshoot", "% of the step"),
    "latency": ("half the window", "s"),
}
#: A measurement has arrived after a step when its errors stay below these: of the vector [%], of the frequency [Hz].
STEP_TVE, STEP_FE = 1.0, 0.005


def modulation_range(performance_class: PerformanceClass, reporting_rate: int) -> float:
    """Highest frequency of modulation [Hz]: Table 5."""
    return min(reporting_rate / 10.0, 2.0) if performance_class == "P" else min(reporting_rate / 5.0, 5.0)


def ramp_exclusion(performance_class: PerformanceClass, reporting_rate: int) -> float:
    """So long before and after a corner of a ramp nothing is measured [s]: Table 7."""
    return (2.0 if performance_class == "P" else 7.0) / reporting_rate


def step_rfe(performance_class: PerformanceClass) -> float:
    """ROCOF has arrived after a step when its error stays below this [Hz/s]: Table 10."""
    return 0.4 if performance_class == "P" else 0.1


def limits_of(nominal: int, performance_class: PerformanceClass, reporting_rate: int) -> tuple[Limit, ...]:
    """All limits of a class at a nominal frequency [Hz] and reporting rate [1/s], in the order of the standard."""
    fast = performance_class == "P"
    steady = (*_steady(fast, reporting_rate), *_modulation(fast, modulation_range(performance_class, reporting_rate)))
    return (*steady, *_ramp(fast), *_steps(fast, nominal, reporting_rate))


def _limits(test: str, values: dict[str, float | None], sources: Iterable[str]) -> Iterable[Limit]:
    return (Limit(test, *each, source) for each, source in zip(values.items(), sources, strict=True))


def _steady(fast: bool, rate: int) -> Iterable[Limit]:
    phasor, rates = f"{_FIRST}, Table 3", f"{_AMENDED}, Table 4"
    sources = (phasor, rates, rates)
    rocof = 0.4 if fast else 0.1
    yield from _limits("signal_frequency", {"tve": 1.0, "fe": 0.005, "rfe": rocof}, sources)
    yield from _limits("signal_magnitude", {"tve": 1.0}, sources[:1])
    yield from _limits("phase_angle", {"tve": 1.0}, sources[:1])
    # Class M has had no limit of ROCOF under harmonics and interference since the amendment suspended it.
    harmonic_fe = 0.005 if fast or rate <= 20 else 0.025
    yield from _limits("harmonic_distortion", {"tve": 1.0, "fe": harmonic_fe, "rfe": rocof if fast else None}, sources)
    if not fast:
        yield from _limits("out_of_band", {"tve": 1.3, "fe": 0.01, "rfe": None}, sources)


def _modulation(fast: bool, highest: float) -> Iterable[Limit]:
    # Proportional to the highest frequency of modulation, 2 Hz or 5 Hz where the reporting rate allows it.
    largest = {"tve": 3.0, "fe": (0.03 if fast else 0.06) * highest, "rfe": 0.18 * 3.141592653589793 * highest**2}
    for test in ("amplitude_modulation", "phase_modulation"):
        yield from _limits(test, dict(largest), (f"{_AMENDED}, Table 5", *(f"{_AMENDED}, Table 6",) * 2))


def _ramp(fast: bool) -> Iterable[Limit]:
    values: dict[str, float | None] = {"tve": 1.0, "fe": 0.01, "rfe": 0.4 if fast else 0.2}
    return _limits("frequency_ramp", values, (f"{_AMENDED}, Table 7", *(f"{_AMENDED}, Table 8",) * 2))


def _steps(fast: bool, nominal: int, rate: int) -> Iterable[Limit]:
    slower = max(1.0 / nominal, 1.0 / rate)
    values: dict[str, float | None] = {
        "tve_response": 2.0 / nominal if fast else 7.0 * slower,
        "delay": 1.0 / (4.0 * rate),
        "overshoot": 5.0 if fast else 10.0,
        "fe_response": 4.5 / nominal if fast else 14.0 * slower,
        "rfe_response": 6.0 / nominal if fast else 14.0 * slower,
    }
    for test in ("magnitude_step", "phase_step"):
        yield from _limits(test, values, (*(f"{_AMENDED}, Table 9",) * 3, *(f"{_AMENDED}, Table 10",) * 2))
    # Of the latency a measurement of a record has its window: computing and sending are not in it.
    yield from _limits("latency", {"latency": (2.0 if fast else 7.0) / rate}, (f"{_AMENDED}, Table 11",))
