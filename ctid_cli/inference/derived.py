"""Poles, time constants, frequencies, damping and gain of estimated models, with their standard errors."""

import math
from dataclasses import dataclass, field

import numpy as np

from ctid_cli.arrays import Array, BoolArray, ComplexArray
from ctid_cli.inference.covariance import LARGE_STANDARD_ERROR
from ctid_cli.inference.intervals import UncertainValue
from ctid_cli.inference.sensitivities import parts_of
from ctid_cli.inference.uncertainty import Uncertainty
from ctid_cli.models.additive import AdditiveModel
from ctid_cli.models.transfer_function import TransferFunction

NAN = float("nan")
GAIN_UNIT = "output unit/input unit"
HELD = "It is at a bound: a given one, or one of the admissible models, because the record does not determine it."
#: A quantity counts as fixed if it changes by less than this fraction for a relative change of 1 of a free pole [-].
UNMOVED = 1e-6


def derived_parameters(
    model: AdditiveModel | TransferFunction, law: Uncertainty, *, level: float = 0.95, held: bool = False
) -> tuple[UncertainValue, ...]:
    r"""Return poles, time constants, frequencies, damping and gain of a model or of submodels, by the delta method.

    The parameters are the leading ones of ``law``, and ``var g = (dg/dtheta) C (dg/dtheta)'`` with analytic
    derivatives, those of the poles from :func:`pole_jacobian`, and ``g +- z se``; for real poles, time constants,
    natural frequencies and damping of stable models the interval is that of the logarithm. The linearisation only holds
    where a pole moves little compared with its distance to the others. A pole whose ``z`` standard errors, ``sqrt(var
    Re p + var Im p)``, reach another pole is called undetermined: its accuracy is NaN and the reason is given. Natural
    frequency and damping of a pair only need it to be far from the *other* poles: they are regular where the pair meets
    on the real axis. If parameters were ``held``, quantities that are constant along the free directions have no
    standard error.

    Each quantity depends on the parameters of its submodel only, so a pole is undetermined only if it cannot be
    distinguished from another one of the same submodel.
    """
    found: list[UncertainValue] = []
    first, additive = 0, isinstance(model, AdditiveModel)
    # The numerator of a fraction may have leading coefficients that are estimated and zero.
    for number, part in enumerate(parts_of(model, len(law.tangent) - model.order - 1), 1):
        a, last = part.denominator, float(part.denominator[-1])
        poles, jacobian = part.pole_slopes()
        stable = bool((poles.real <= 0.0).all())
        rows = _Rows(law, level, held, first, f"g{number}_" if additive else "", stable)
        rows.add_poles(poles, jacobian, number_lone=not additive)
        if additive and poles.size == 2 and a[0] > 0 and not poles.imag.any():
            # Two real poles, also close ones: natural frequency a_2^(-1/2) and damping a_1 a_2^(-1/2) / 2.
            frequency, slope = a[0] ** -0.5, -0.5 * a[0] ** -1.5
            turning = 0.5 * np.array([frequency, a[1] * slope])
            rows.add_mode("", frequency, np.array([0.0, slope]), 0.5 * a[1] * frequency, turning)
        integrates = part.integrators > 0 or last == 0
        gain = math.inf if integrates else float(part.numerator[-1] / last)
        # Only the coefficients of p^0 matter: of B, and of A if it is free.
        slopes = [-gain if power == 0 else 0.0 for power in part.a_powers]
        slopes += [float(power == 0) for power in part.b_powers]
        which = "This submodel integrates" if additive else "The model integrates (a pole at the origin)"
        reason = f"{which} and has no static gain." if integrates else ""
        rows.add("static_gain", gain, np.array(slopes) / (last or 1.0), GAIN_UNIT, reason)
        found += rows.found
        first += part.size
    return tuple(found)


@dataclass
class _Rows:
    """Quantities that depend on the parameters of one model or submodel."""

    law: Uncertainty
    level: float
    held: bool = False
    #: Index of the first parameter of the gradients, and prefix of the names of the quantities.
    first: int = 0
    prefix: str = ""
    #: Whether all poles but integrators are stable.
    stable: bool = True
    found: list[UncertainValue] = field(default_factory=list)

    def add(
        self, name: str, estimate: float, gradient: Array, unit: str, reason: str = "", *, signed: bool = True
    ) -> None:
        """Add one quantity, from its gradient; with a reason, it has no standard error.

        Unless it is ``signed``, its sign is known for stable models, and its interval is that of its logarithm.
        """
        gradient = np.concatenate((np.zeros(self.first), gradient))
        if self.held and not reason:
            moved = np.abs(self.law.along(gradient)).max(initial=0.0)
            reason = HELD if moved <= UNMOVED * abs(estimate) else ""
        error = self.law.error(gradient) if np.isfinite(gradient).all() and not reason else NAN
        if not reason and (not np.isfinite(error) or (not signed and error > LARGE_STANDARD_ERROR * abs(estimate) > 0)):
            error, reason = NAN, "The data do not determine it."
        reach = self.law.quantile(gradient, self.level) if np.isfinite(error) else NAN
        found = UncertainValue.symmetric(self.prefix + name, estimate, error, unit, reach, reason)
        self.found.append(found if signed or not estimate or not np.isfinite(error) else found.in_logarithm)

    def add_mode(
        self, label: str, frequency: float, radial: Array, damping: float, turning: Array, reason: str = ""
    ) -> None:
        """Add natural frequency, in rad/s and Hz, and damping of two poles."""
        hertz = frequency / (2 * np.pi), radial / (2 * np.pi)
        self.add(f"natural_frequency{label}", frequency, radial, "rad/s", reason, signed=False)
        self.add(f"natural_frequency{label}_hz", *hertz, "Hz", reason, signed=False)
        self.add(f"damping{label}", damping, turning, "-", reason, signed=not self.stable)

    def add_poles(self, poles: ComplexArray, jacobian: ComplexArray, *, number_lone: bool = True) -> None:
        """Add poles, time constants, natural frequencies and damping."""
        upper = [k for k, pole in enumerate(poles) if pole.imag >= 0]
        for number, k in enumerate(upper, 1):
            label = f"_{number}" if number_lone or len(upper) > 1 else ""
            pole, slope = poles[k], jacobian[k]
            x, y = float(pole.real), float(pole.imag)
            others = np.arange(poles.size) != k
            reason = self._undetermined(poles, k, slope, others)
            if pole.imag == 0:
                self.add(f"pole{label}", x, slope.real, "rad/s", reason, signed=not self.stable)
                if x == 0:
                    reason = "The pole lies at the origin: it integrates and has no time constant."
                    self.add(f"time_constant{label}", float("inf"), slope.real, "s", reason)
                else:
                    self.add(
                        *(f"time_constant{label}", -1.0 / x, slope.real / x**2, "s", reason), signed=not self.stable
                    )
                continue
            frequency = abs(complex(pole))
            self.add(f"pole{label}_real", x, slope.real, "rad/s", reason)
            self.add(f"pole{label}_imag", y, slope.imag, "rad/s", reason)
            # d(x^2 + y^2) = 2 Re(conj(p) dp)
            radial = (x * slope.real + y * slope.imag) / frequency
            turning = y * (x * slope.imag - y * slope.real) / frequency**3
            reason = self._undetermined(poles, k, slope, others & (poles != np.conj(pole)))
            self.add_mode(label, frequency, radial, -x / frequency, turning, reason)

    def _undetermined(self, poles: ComplexArray, k: int, slope: ComplexArray, others: BoolArray) -> str:
        """Return the reason why pole k has no standard error, or an empty string."""
        if indistinct(poles, k, np.concatenate((np.zeros(self.first), slope)), others, self.law, self.level):
            return "This pole has no standard error: these data cannot distinguish it from another pole."
        return ""


def indistinct(
    poles: ComplexArray, k: int, slope: ComplexArray, others: BoolArray, law: Uncertainty, level: float
) -> bool:
    """Return whether the interval of pole k, with the given derivatives, reaches another pole.

    Distances of real stable poles, and their intervals, are those of logarithms.
    """
    if not others.any():
        return False
    distance = float(np.abs(poles[others] - poles[k]).min())
    if distance <= 1e-7 * float(np.abs(poles).max()) or not np.isfinite(slope).all():
        return True
    spread = math.hypot(law.error(slope.real), law.error(slope.imag))
    if not poles.imag.any() and (poles.real < 0.0).all():
        distance = float(np.abs(np.log(poles[others].real / poles[k].real)).min()) * abs(float(poles[k].real))
    return law.quantile(slope.real, level) * spread >= distance


def modes_of(poles: ComplexArray) -> list[tuple[float, float | None]]:
    """Return natural frequency [1/time unit] and damping of each real pole and pair; an integrator has no damping.

    The frequency ``|p|/(2 pi)`` is in hertz where poles are in rad/s; the damping is ``-Re p/|p|``.
    """
    above = [pole for pole in poles.tolist() if pole.imag >= 0]
    return [(abs(pole) / (2 * np.pi), -pole.real / abs(pole) if pole else None) for pole in above]
