r"""What records determine: models that they do not reject, and the intervals that follow from them.

Intervals from a covariance hold near one interior minimum. With S the squared error, whitened by the noise of the
estimate, and p the parameters, records do not reject a model with

.. math:: S \le S_{\min} \Big(1 + \frac{c\,t^2}{N - p}\Big),

where t is the quantile of a 95 % interval and c the inflation by coloured noise. Three kinds of such models make
intervals longer than their covariance says: other minima; minima for other values of a delay whose interval reaches the
bound of its range; and minima for other values of a pole at a bound of the admissible set, or of a parameter at a given
bound. About a minimum whose relative rise is r of the allowed one, a quantity g has the interval

.. math:: g \pm t \sqrt{1 - r}\; \mathrm{se}(g),

and those of neighbouring values of a delay, pole or parameter form one interval.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any, NamedTuple

import numpy as np

from ctid_cli.errors import CtidError
from ctid_cli.estimation.measured_records import MeasuredRecords
from ctid_cli.estimation.optimum.best_model import Optimum
from ctid_cli.estimation.optimum.box import each_bounds
from ctid_cli.estimation.optimum.known import NOTHING, KnownCoefficients
from ctid_cli.estimation.parameter_layout import Degrees
from ctid_cli.estimators.measured_fit import MeasuredFit, delay_names, fitted
from ctid_cli.inference.criteria import squared_innovations
from ctid_cli.inference.intervals import NOT_DETERMINED, CostOfDelay, UncertainValue, student_quantile
from ctid_cli.inference.noise_model import NoiseModel, fit_noise_model
from ctid_cli.inference.sensitivities import SumStructure
from ctid_cli.inference.uncertainty import Uncertainty
from ctid_cli.models.additive import AdditiveModel
from ctid_cli.models.several_inputs import delays_of
from ctid_cli.progress import reported

#: Delays in its interval for which minima are computed.
DELAYS = 7
#: Steps in the logarithm of a coefficient from a pole at a bound, and in shares of the range of a bounded parameter.
LOGARITHMS = 0.25, 0.75, 1.5, 3.0, 5.0, 8.0, 11.0, 14.0, 17.0
#: A quantity only reflects the bound of a pole if its logarithm changes by more than this share of the change of that
#: of the pole at the bound.
REFLECTS = 0.1
#: A gain is given as several intervals if together they reach this share of it to each side; else it is undetermined.
NARROW = 0.25

#: Fields of a fit that differ between minima.
OF_A_MINIMUM = (
    *("model", "status", "cost", "fit_percent", "r2", "condition_number", "iterations", "theta", "initial_states"),
    *("offsets", "residuals", "sensitivities", "rounding", "box", "held_poles", "tangent"),
)
OTHER_MINIMA = f"{NOT_DETERMINED}: other minima fit as well."
AT_OUR_BOUND = f"{NOT_DETERMINED}: a pole is at the bound of the admissible models, which it reflects."
#: Difference of two delays from a multiple of a shift, as a share of it, up to which they are equivalent.
SAME_SHIFT = 0.05
#: Confidence level of intervals and tests.
LEVEL = 0.95


class Accepted(NamedTuple):
    """Model that the records do not reject."""

    fit: MeasuredFit
    law: Uncertainty
    #: Rise of the squared error as a share of the largest that is not rejected, between 0 and 1.
    rise: float


class AtBound(NamedTuple):
    """Model with a pole at a bound of the admissible set, and one beside it, where the pole is inside."""

    here: Accepted
    inside: Accepted
    #: Whether the pole is at the slow bound, else at the fast one.
    slow: bool


@dataclass(frozen=True, eq=False)
class Determination:
    """Models that records do not reject, in chains of neighbouring ones; the first begins with the estimate."""

    chains: tuple[tuple[Accepted, ...], ...]
    #: Neighbouring models at a bound of a pole, the first at the bound; the end of the interval is ours.
    at_our_bound: tuple[AtBound, ...] = ()

    @property
    def trivial(self) -> bool:
        """Whether the estimate is the only one."""
        return len(self.chains) == 1 and len(self.chains[0]) == 1 and not self.at_our_bound

    def reported(self, values: Callable[[MeasuredFit, Uncertainty], Sequence[UncertainValue]]) -> list[UncertainValue]:
        """Return quantities of the estimate with intervals from all models."""
        first = self.chains[0][0]
        found = list(values(first.fit, first.law))
        if self.trivial:
            return found
        others = {
            id(each.fit): {item.name: item for item in values(each.fit, each.law)}
            for chain in (*self.chains, *(pair[:2] for pair in self.at_our_bound))
            for each in chain
        }
        return [self._reported(item, others) for item in found]

    def _reported(self, item: UncertainValue, of: Mapping[int, Mapping[str, UncertainValue]]) -> UncertainValue:
        if item.status in ("fixed", "undetermined"):
            return item
        ends = [[of[id(each.fit)].get(item.name) for each in pair[:2]] for pair in self.at_our_bound]
        if any(_reflects(pair, own) for pair, own in zip(self.at_our_bound, ends, strict=True)):
            return item.undetermined(AT_OUR_BOUND)
        if item.reason:
            return item
        hulls, estimates = list[tuple[float, float]](), list[float]()
        for chain in self.chains:
            pieces = []
            least = 0.0 if item.name.endswith("delay") else -np.inf
            for each in chain:
                own = of[id(each.fit)].get(item.name)
                if own is not None and np.isfinite(own.estimate):
                    pieces.append(_interval(own, each.rise))
            if pieces:
                hulls.append((max(min(low for low, _ in pieces), least), max(high for _, high in pieces)))
                estimates.append(of[id(chain[0].fit)][item.name].estimate)
        if not hulls:
            return item
        merged = _merged(hulls)
        if len(merged) > 1 and item.name.endswith("static_gain"):
            low, high = merged[0][0], merged[-1][1]
            if not (low * high > 0 and high - low <= 2 * NARROW * abs(item.estimate)):
                return item.undetermined(OTHER_MINIMA, tuple(dict.fromkeys(estimates)))
        return item.with_intervals(merged)


def _interval(item: UncertainValue, rise: float) -> tuple[float, float]:
    """Return the interval of a quantity about a minimum; of length zero if it is held there."""
    if not (np.isfinite(item.low) and np.isfinite(item.high)):
        return item.estimate, item.estimate
    share = float(np.sqrt(max(1.0 - rise, 0.0)))
    return item.estimate - share * (item.estimate - item.low), item.estimate + share * (item.high - item.estimate)


def _reflects(pair: AtBound, items: Sequence[UncertainValue | None]) -> bool:
    """Return whether a quantity follows a pole at its bound."""
    if items[0] is None or items[1] is None:
        return False
    values = np.array([items[0].estimate, items[1].estimate])
    moved = float(np.abs(np.log(_size_of_pole(pair))))
    if not np.isfinite(values).all() or not moved > 0.0 or values[0] == values[1]:
        return False
    return bool(values.prod() <= 0.0 or abs(np.log(values[0] / values[1])) > REFLECTS * moved)


def _size_of_pole(pair: AtBound) -> float:
    """Return the ratio of the magnitudes of the pole at its bound in two models."""
    poles, others = (np.sort(np.abs(each.fit.model.poles)) for each in pair[:2])
    k = 0 if pair.slow else -1
    return float(poles[poles > 0.0][k] / others[others > 0.0][k])


def _merged(intervals: Sequence[tuple[float, float]]) -> tuple[tuple[float, float], ...]:
    """Return the union of intervals in ascending order."""
    found: list[tuple[float, float]] = []
    for low, high in sorted(intervals):
        if found and low <= found[-1][1]:
            found[-1] = found[-1][0], max(found[-1][1], high)
        else:
            found.append((low, high))
    return tuple(found)


# --- models that are not rejected --------------------------------------------------------------------


@reported("what the records determine")
def determination_of(
    fit: MeasuredFit, law: Uncertainty, measured: object, inside: Sequence[Iterator[Optimum]] = ()
) -> Determination:
    """Return the models that records do not reject; the estimate alone if it is an interior, isolated minimum.

    ``inside``: minima ever farther inside each given bound that a parameter is at.
    """
    alone = Determination(((Accepted(fit, law, 0.0),),))
    if not isinstance(measured, MeasuredRecords) or not law.defined:
        return alone
    near = measured.near(fit.residuals, fit.weighting, fit.arma)
    limit = _Limit(fit, law)
    if not limit.allowed > 0.0:
        return alone
    first = [alone.chains[0][0]]
    for optima in inside:
        first += [each for each in limit.towards(near, optima) if each.rise < 1.0]
    if fit.bounds_met:
        # Beyond a given bound the squared error is lower: other searches would leave it.
        return Determination((tuple(first),))
    for k in _uncertain_delays(fit, law, near):
        first += limit.along_delay(near, k)
    others = list[tuple[Accepted, ...]]()
    for each in limit.others(near):
        between = limit.between(near, each)
        if between is None:
            others.append((each,))
        else:
            first += [*between, each]
    pairs = list[AtBound]()
    for end in (_slow_end, _fast_end):
        # Of the models that are not rejected, the first that has a pole at this end.
        for at_end in (*first, *(each for chain in others for each in chain)):
            models = list(limit.towards(near, end(at_end.fit, near)))
            if models:
                first += [each for each in models if each.rise < 1.0]
                pairs.append(AtBound(at_end, models[0], end is _slow_end))
                break
    return Determination((tuple(first), *others), tuple(pairs))


class _Limit:
    """Largest squared error of models that are not rejected, and the noise of the estimate."""

    def __init__(self, fit: MeasuredFit, law: Uncertainty) -> None:
        self.fit, self.law, self.linear = fit, law, fit.linear
        self.freedom = self.linear.count - law.free_covariance.shape[0]
        reach = student_quantile(law.degrees_of_freedom, LEVEL)
        self.allowed = reach**2 / self.freedom if self.freedom > 0 else 0.0
        self.coloured = law.kind != "white" and fit.noise is None

    @cached_property
    def noise(self) -> NoiseModel:
        """Autoregressive model of the residuals of the estimate."""
        residuals = self.linear.residuals
        return fit_noise_model(residuals, penalty=float(np.log(sum(block.size for block in residuals))))

    def law_of(self, fit: MeasuredFit) -> Uncertainty:
        """Return the uncertainty of another minimum, for the kind of noise of the estimate."""
        return fit.uncertainty("white" if self.law.kind == "white" else "robust")

    def of(self, near: MeasuredRecords, found: Optimum) -> MeasuredFit | None:
        """Return another minimum with the treatment of the estimate; None if it has fewer poles."""
        with suppress(CtidError, np.linalg.LinAlgError):
            other = fitted(near, found, None)
            if other.parameter_names == self.fit.parameter_names:
                values: dict[str, Any] = {name: getattr(other, name) for name in OF_A_MINIMUM}
                structure = near.structure
                if isinstance(structure, SumStructure):
                    size = sum(term.size for term in structure.terms)
                    values["additive"] = AdditiveModel.from_theta(
                        other.theta[:size], structure.terms, other.model.delay
                    )
                return replace(self.fit, weighting=None, **values)
        return None

    def rise(self, found: Optimum, inflation: float = 1.0) -> float:
        """Return the rise of the squared error of a minimum as a share of the allowed one."""
        least = self.linear.cost * self.linear.count
        return max(found.squared_error / least - 1.0, 0.0) / (inflation * self.allowed) if least > 0 else np.inf

    def whitened_rise(self, other: MeasuredFit) -> float:
        """Return that of another minimum after a step of generalised least squares in the noise of the estimate."""
        noise = self.noise
        both = [
            squared_innovations(each.residuals, [psi @ each.tangent for psi in each.sensitivities], noise)
            for each in (self.linear, other.linear)
        ]
        return max(both[1] / both[0] - 1.0, 0.0) / self.allowed if both[0] > 0.0 else np.inf

    def others(self, near: MeasuredRecords) -> Iterator[Accepted]:
        """Yield other minima of the search that are not rejected."""
        for start in self.fit.other_minima:
            with suppress(CtidError, np.linalg.LinAlgError):
                found = near.local(start)
                other = self.of(near, found)
                if other is None or _same(other, self.fit) or _equivalent(other, self.fit, near):
                    continue
                rise = self.whitened_rise(other) if self.coloured else self.rise(found)
                if rise < 1.0:
                    yield Accepted(other, self.law_of(other), rise)

    def along_delay(self, near: MeasuredRecords, k: int) -> Iterator[Accepted]:
        """Yield minima at other delays of an input, in its interval."""
        profile, reach, _ = cost_of_delay(near, self.linear, self.law, delay_names(self.fit)[k])
        interval = profile.interval(reach)
        if not np.isfinite([interval.low, interval.high]).all():
            return
        for delay in np.linspace(interval.low, interval.high, DELAYS).tolist():
            found = _at_delays(near, self.fit, {k: delay})
            other = None if found is None else self.of(near, found)
            if found is not None and other is not None:
                rise = self.rise(found, profile.inflation)
                if rise <= 1.0 + 1e-3:
                    yield Accepted(other, self.law_of(other), min(rise, 1.0))

    def between(self, near: MeasuredRecords, other: Accepted) -> list[Accepted] | None:
        """Return minima at delays between those of the estimate and of another minimum; None if one is rejected."""
        # Without another delay nothing connects them.
        if delays_of(self.fit.model) == delays_of(other.fit.model):
            return None
        start, stop = (np.array(delays_of(each.model)) for each in (self.fit, other.fit))
        free = [k for k, (low, high) in enumerate(each_bounds(near.treatment.delay_bounds)) if low < high]
        found = list[Accepted]()
        for delays in np.linspace(start, stop, DELAYS)[1:-1].tolist():
            held = {k: delays[k] for k in free}
            optima = [_at_delays(near, each, held) for each in (self.fit, other.fit)]
            least = min(filter(None, optima), key=lambda one: one.squared_error, default=None)
            fit = None if least is None else self.of(near, least)
            if least is None or fit is None or self.rise(least, self.inflation) >= 1.0:
                return None
            found.append(Accepted(fit, self.law_of(fit), self.rise(least, self.inflation)))
        return found

    def towards(self, near: MeasuredRecords, optima: Iterator[Optimum]) -> Iterator[Accepted]:
        """Yield minima ever farther from a bound, up to the first that is rejected."""
        for found in optima:
            other, rise = self.of(near, found), self.rise(found, self.inflation)
            if other is None:
                return
            yield Accepted(other, self.law_of(other), rise)
            if rise >= 1.0:
                return

    @cached_property
    def inflation(self) -> float:
        """Median factor by which coloured noise increases the variances of the parameters."""
        white = np.diag(self.linear.uncertainty("white").free_covariance)
        if self.law.kind == "white" or not (white > 0.0).any():
            return 1.0
        ratios = np.diag(self.law.free_covariance)[white > 0.0] / white[white > 0.0]
        return max(1.0, float(np.median(ratios)))


def _same(one: MeasuredFit, other: MeasuredFit) -> bool:
    """Return whether two minima agree within rounding."""
    scale = np.maximum(np.abs(one.theta), np.abs(other.theta))
    return bool(np.all(np.abs(one.theta - other.theta) <= 1e-4 * scale))


def _equivalent(other: MeasuredFit, fit: MeasuredFit, near: MeasuredRecords) -> bool:
    """Return whether another minimum is that of a fit after shifts of a repeating input, up to noise."""
    found = False
    for k, (one, delay) in enumerate(zip(delays_of(other.model), delays_of(fit.model), strict=True)):
        shifts = [each.shift for each in near.repetitions[k]]
        away = [(one - delay) / shift for shift in shifts]
        whole = any(round(each) and abs(each - round(each)) < SAME_SHIFT for each in away)
        if not whole and any(abs(each) >= SAME_SHIFT for each in away):
            return False
        found |= whole
    return found


def _uncertain_delays(fit: MeasuredFit, law: Uncertainty, near: MeasuredRecords) -> Iterator[int]:
    """Yield the inputs with a free delay that is at a bound of its range, or has an interval that reaches one."""
    covariance = law.covariance
    for k, (name, bounds) in enumerate(zip(delay_names(fit), each_bounds(near.treatment.delay_bounds), strict=True)):
        if name not in fit.parameter_names:
            continue
        place = fit.parameter_names.index(name)
        if not fit.tangent[place].any():
            yield k
            continue
        half = law.quantile(np.eye(fit.theta.size)[place], LEVEL) * float(np.sqrt(covariance[place, place]))
        delay = float(fit.theta[place])
        if delay - half < bounds[0] or delay + half > bounds[1]:
            yield k


def _at_delays(near: MeasuredRecords, fit: MeasuredFit, delays: Mapping[int, float]) -> Optimum | None:
    """Return the least squared error at known delays of some inputs, by their indices, in the basin of a fit."""
    each = [delays.get(k, own) for k, own in enumerate(delays_of(fit.model))]
    with suppress(CtidError, np.linalg.LinAlgError):
        found = near.with_delays(delays).local((near.begin(fit.parametrised)[0], tuple(each)))
        return replace(found, delays_at_bound=tuple(sorted({*found.delays_at_bound, *delays})))
    return None


def _slow_end(fit: MeasuredFit, near: MeasuredRecords) -> Iterator[Optimum]:
    """Yield minima with ever faster slowest poles, from one at the slow bound: by the last coefficient of A."""
    degrees = near.degrees
    if fit.box is None or not isinstance(degrees, Degrees) or not degrees.common:
        return
    slow = [pole for pole in fit.held_poles if abs(pole) <= fit.box.slowest * (1 + 1e-6)]
    if not slow:
        return
    integrators = degrees.integrators[0]
    poles, size = degrees.orders[0] - integrators - fit.poles_at_infinity, near.problem.coefficients
    last = float(fit.theta[poles - 1])
    known = near.known
    denominator = np.full(poles, np.nan) if known is NOTHING else known.denominator.copy()
    numerator = np.full(size, np.nan) if known is NOTHING else known.numerator
    if denominator.size != poles or np.isfinite(denominator[-1]):
        return
    begin = near.begin(fit.parametrised)
    for step in LOGARITHMS:
        denominator = denominator.copy()
        denominator[-1] = last * np.exp(step)
        other = copy(near)
        other.known = KnownCoefficients(denominator, numerator)
        with suppress(CtidError, np.linalg.LinAlgError):
            found = other.local(begin)
            begin = found.start
            yield found
            continue
        return


def _fast_end(fit: MeasuredFit, near: MeasuredRecords) -> Iterator[Optimum]:
    """Yield minima with ever slower fastest poles, from one at the fast bound."""
    if fit.box is None or near.problem.terms:
        return
    fast = [pole for pole in fit.held_poles if abs(pole) >= fit.box.fastest * (1 - 1e-6)]
    begin = near.begin(fit.parametrised) if fast else None
    for step in LOGARITHMS if fast else ():
        box = replace(fit.box, fastest=fit.box.fastest * float(np.exp(-step)))
        assert begin is not None
        if box.fastest <= box.slowest:
            return
        with suppress(CtidError, np.linalg.LinAlgError):
            found = near.local(begin, box=box)
            begin = found.start
            yield found
            continue
        return


def cost_of_delay(
    measured: MeasuredRecords, fit: MeasuredFit, uncertainty: Uncertainty, name: str = "delay"
) -> tuple[CostOfDelay, float, float]:
    """Return the cost about a delay, the quantile of its interval, and its standard error."""
    place, k = fit.parameter_names.index(name), delay_names(fit).index(name)
    held = not fit.tangent[place].any()
    if held:
        # The effect of the noise on a delay at a bound is that of a free one.
        fit = replace(fit, tangent=np.column_stack((fit.tangent, np.eye(fit.theta.size)[place])))
        uncertainty = fit.uncertainty("white" if uncertainty.kind == "white" else "robust")
    variance = float(uncertainty.covariance[place, place])
    white = float(fit.uncertainty("white").covariance[place, place])
    profile = CostOfDelay(
        cache(lambda trial: measured.squared_error_at(fit.parametrised, trial, k)),
        float(fit.theta[place]),
        fit.cost * fit.count,
        fit.count,
        fit.theta.size - len(fit.known),
        each_bounds(measured.treatment.delay_bounds)[k],
        max(variance / white, np.finfo(float).tiny),
    )
    reach = uncertainty.quantile(np.eye(fit.theta.size)[place], LEVEL)
    return profile, reach, float("nan") if held else float(np.sqrt(variance))
