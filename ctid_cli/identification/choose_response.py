r"""Choice of the structure of a model of a frequency response, by one criterion and by lines that are held back.

Structures of increasing order, with and without an integrator and a delay, are fitted until the best one lies two
orders below the last. With V the sum of squared weighted errors, N the number of real equations and p that of
parameters, the best has the least

.. math:: N \ln (V / N) + 1.5\,p \ln N .

A common factor of the standard errors is thereby free. Standard errors of measured responses are often estimates, or
off by a factor; known ones would improve the estimate of that factor, from N equations, only. Correlated lines are
whitened by one autoregressive model for all structures.

The smallest structure is taken that predicts lines which are held back as well as the best one, and has its peaks.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from ctid_cli import progress
from ctid_cli.arrays import Array, IntArray
from ctid_cli.errors import CtidError, DataError, OptionError
from ctid_cli.estimation.measured_lines import MeasuredLines, lines_of
from ctid_cli.estimators.frequency_domain import FrequencyDomain, FrequencyDomainFit
from ctid_cli.identification.choice import Given, Span
from ctid_cli.identification.choose import rounded
from ctid_cli.identification.criterion import BLOCKS, FOLDS, LEAST_SHARE, difference
from ctid_cli.identification.response_structures import (
    ROUNDING,
    Family,
    Judged,
    clear_peaks,
    complex_errors,
    greatest_delay,
    noise_scale,
    white_over_lines,
)
from ctid_cli.identification.sentences import shown
from ctid_cli.inference.criteria import PENALTY, innovations_count, squared_innovations
from ctid_cli.inference.noise_model import NoiseModel, fit_noise_model
from ctid_cli.inference.response_test import LEVEL, ResponseTest
from ctid_cli.processors import one_thread
from ctid_cli.progress import reported
from ctid_cli.signals.frequency_data import FrequencyData
from ctid_cli.text import count

#: Most poles that are tried unasked, if these miss more than noise, and with peaks that need more; the grid ends this
#: many poles above the best structure, and at this order at the least.
MOST, MORE, GREATEST, BEYOND, FEWEST = 6, 10, 12, 2, 4
#: Fewest lines of which some are held back.
FEWEST_LINES = 30
#: Standard errors by which a peak exceeds a model that misses it.
MISSED = 5.0
#: Greatest decrease of the gain with frequency [decades per decade] of a response that does not fall.
FLAT = -0.5
#: Decrease of the negative log-likelihood from which errors grow with the gain.
GROWS = 10.0


@dataclass(frozen=True, eq=False)
class ResponseChoice:
    """A structure for a frequency response, with the structures from which it was chosen."""

    data: FrequencyData = field(repr=False)
    #: Options to fit.
    options: FrequencyDomain
    #: All structures, that of least criterion first.
    judged: tuple[Judged, ...] = field(repr=False)
    #: Order of the autoregressive model of the errors over the lines.
    noise_order: int
    #: One sentence for each choice.
    sentences: tuple[str, ...]
    #: Sentences, without full stops, on peaks that the chosen structure does not describe, and on better weights.
    missed: tuple[str, ...]

    @property
    def taken(self) -> Judged:
        """The chosen structure."""
        return next(each for each in self.judged if each.taken)

    @property
    def answer(self) -> ResponseTest:
        """Test of the values against noise."""
        return answer_of_lines(self.taken.fit)

    def words(self) -> list[str]:
        """Return the choice as options of ``ctid fit``."""
        options, (low, high) = self.options, self.options.delay_bounds
        integrators = ["--integrators", f"{options.integrators}"] * bool(options.integrators)
        delay = f"{low:g}:{high:g}" if low < high else f"{low:g}"
        return ["--poles", f"{options.poles}", "--zeros", f"{options.zeros}", *integrators, "--delay", delay]


@one_thread
@reported("choosing the structure")
def choose_response(data: FrequencyData, given: Given | None = None) -> ResponseChoice:
    """Choose those parts of the structure of a model of a frequency response that are not given.

    Given are poles, zeros, integrators, the range of the delay, and known or bounded parameters. A DataError states
    that there are too few lines, an OptionError that given options contradict each other or are those of records.
    """
    given = given or Given()
    for name in ("initial_state", "offset", "input_before", "loss", "inputs", "modes"):
        if getattr(given, name) is not None:
            raise OptionError(name, f"{name} is not available for the structure of a frequency response; drop it")
    given.check()
    return _Choosing(data, given).choice()


class _Choosing:
    """The steps of a choice."""

    def __init__(self, data: FrequencyData, given: Given) -> None:
        self.data, self.given, self.lines = data, given, lines_of(data)
        self.scale = noise_scale(self.lines.frequencies, self.lines.weights * self.lines.response)
        self.reach = rounded(greatest_delay(data, self.scale))
        self.peaks = clear_peaks(data, self._errors(self.scale))
        #: Order up to which structures are tried, and why it was raised.
        fewest = given.zeros if isinstance(given.zeros, int) else (given.zeros or (0, 0))[0]
        self.limit = max(MOST, min(2 * self.peaks.size, GREATEST), fewest + 1)
        self.why = f"the response has {count(self.peaks.size, 'clear peak')}"

    def _errors(self, scale: float) -> Array:
        """Return standard errors of the complex values, if that of a weighted real part is ``scale``."""
        return np.asarray(np.sqrt(2.0) * scale / self.lines.weights)

    def choice(self) -> ResponseChoice:
        """Return the choice."""
        judged, noise = self._ranked(self._grid())
        judged = self._judged(judged, noise)
        taken = next(each for each in judged if each.taken)
        missed = (*self._missed_peaks(taken, judged), *_about_weights(taken.fit))
        sentences = tuple(self._sentences(taken, judged, noise))
        return ResponseChoice(self.data, taken.options, judged, noise.order, sentences, missed)

    # --- structures ------------------------------------------------------------------------------------

    def _families(self) -> list[Family]:
        """Return the admitted numbers of integrators, with and without a delay."""
        given, bounds, found = self.given, self.given.delay_bounds, list[Family]()
        tried = given.integrators is None and not isinstance(given.poles, int) and self._slope(first=True) < FLAT
        delays = [(0.0, self.reach), (0.0, 0.0)] if bounds is None else [bounds]
        for number in (0, 1) if tried else (given.integrators or 0,):
            near = None
            for each in delays:
                options = FrequencyDomain(int(not number), 0, each, integrators=number)
                near = Family(self.data, options, given, self.scale**2, near)
                found.append(near)
        return found

    def _grid(self) -> list[Judged]:
        """Fit structures of increasing order, until the best lies inside the grid or none is left."""
        given, families, found = self.given, self._families(), list[Judged]()
        poles = (given.poles, given.poles) if isinstance(given.poles, int) else given.poles or (0, GREATEST)
        zeros = (given.zeros, given.zeros) if isinstance(given.zeros, int) else given.zeros or (0, GREATEST)
        span = Span(poles, zeros)
        most = poles[1] + max(family.options.integrators for family in families)
        asked = given.poles is not None
        order = 0
        while order < (most if asked else self.limit):
            order += 1
            progress.report("order", order, most if asked else self.limit)
            tried = list[Judged]()
            for family in families:
                known = family.options.delay_bounds[0] == family.options.delay_bounds[1]
                proper = not known or (given.zeros is None and self._slope(first=False) < FLAT)
                tried += family.tried(order, span, proper=proper)
            found += tried
            if not tried and found:
                break
            if order < FEWEST or not found:
                continue
            white, _ = self._ranked(found, correlated=False)
            inside = order - white[0].order >= BEYOND
            if inside and order - self._ranked(found)[0][0].order >= BEYOND:
                break
            if order == self.limit and not inside and (why := self._why_more(white[0])):
                self.limit, self.why = self.limit + BEYOND, why
        if not found:
            for refusal in filter(None, (family.refusal for family in families)):
                raise refusal
            raise DataError(f"{self._head}the lines are too few for a model's parameters; give more frequencies")
        return found

    @property
    def _head(self) -> str:
        return f"{self.data.name}: " if self.data.name else ""

    def _why_more(self, best: Judged) -> str:
        """Return why larger structures than the best are needed: missed peaks, or correlated errors; empty if not."""
        if self.limit < GREATEST and self._missed(best, best).size:
            return f"{count(best.order, 'pole')} miss a clear peak"
        coloured = not self.data.correlated and not white_over_lines(best.fit.residuals[0], self.lines.frequencies.size)
        return f"{count(best.order, 'pole')} leave correlated errors" if self.limit < MORE and coloured else ""

    def _slope(self, *, first: bool) -> float:
        """Return the slope of the logarithm of the gain at the first, or the last, quarter of the lines; 0 at rest."""
        w, gain = self.lines.frequencies, np.abs(self.data.response)
        if first and w[0] == 0.0:
            return 0.0
        part = (w > 0.0) & (gain > 0.0) & ((w <= np.quantile(w, 0.25)) if first else (w >= np.quantile(w, 0.75)))
        if np.unique(w[part]).size < 3:
            return -1.0
        return float(np.polyfit(np.log(w[part]), np.log(gain[part]), 1)[0])

    def _ranked(
        self, found: Iterable[Judged], *, correlated: bool | None = None
    ) -> tuple[tuple[Judged, ...], NoiseModel]:
        """Rank structures by their criterion, inadmissible ones last, with the noise model of the closest."""
        each, half = list(found), self.lines.frequencies.size
        closest = min(each, key=lambda one: (not one.admissible, one.fit.cost)).fit
        residuals = np.split(closest.residuals[0], [half])
        n, rounding = closest.count, ROUNDING * float(self.lines.y_used @ self.lines.y_used)
        correlated = self.data.correlated if correlated is None else correlated
        noise = fit_noise_model(residuals, None if correlated else 0, float(np.log(n)))
        ranked = []
        for one in each:
            errors, psi = (
                np.split(part, [half]) for part in (one.fit.residuals[0], one.fit.sensitivities[0] @ one.fit.tangent)
            )
            squared, own = squared_innovations(errors, psi, noise), innovations_count(residuals, noise)
            value = own * np.log(max(squared, rounding) / own) + PENALTY * one.parameters * np.log(own)
            ranked.append(one._replace(criterion=float(value)))
        return tuple(sorted(ranked, key=lambda one: (not one.admissible, one.criterion))), noise

    # --- lines that are held back ----------------------------------------------------------------------

    @reported("held-back lines")
    def _judged(self, ranked: tuple[Judged, ...], noise: NoiseModel) -> tuple[Judged, ...]:
        """Return the structures, compared on held-back lines, with the smallest acceptable one taken."""
        best, lines = ranked[0], self.lines.frequencies.size
        compared: dict[tuple[int, int], Judged] = {}
        for each in ranked:
            if each is best or (each.admissible and each.parameters < best.parameters):
                compared.setdefault((each.options.integrators, each.order), each)
        if lines < FEWEST_LINES or len(compared) < 2:
            return (best._replace(taken=True), *ranked[1:])
        # Blocks are as wide as the lines are correlated, and spread over all frequencies.
        width = max(1, min(noise.order + 1, lines // (2 * BLOCKS)))
        blocks = np.arange(lines) // width % BLOCKS
        errors = {id(each): self._held_back(each, blocks) for each in compared.values()}
        if not np.isfinite(errors[id(best)]).all():
            return (best._replace(taken=True), *ranked[1:])
        squares = {key: np.array([np.mean(own[blocks == k]) for k in range(BLOCKS)]) for key, own in errors.items()}
        least = max(LEAST_SHARE * float(np.mean(errors[id(best)])), np.finfo(float).tiny)
        logs = {key: np.log(np.maximum(own, least)) for key, own in squares.items()}
        found, acceptable, missed = dict[int, Judged](), [id(best)], set(self._missed(best, best).tolist())
        for each in compared.values():
            key = id(each)
            if not np.isfinite(errors[key]).all():
                continue
            mean, error = difference(logs[key], logs[id(best)])
            held = float(np.mean(errors[key])) / max(best.fit.cost, np.finfo(float).tiny)
            found[key] = each._replace(held_back=held, difference=mean, standard_error=error)
            # A narrow peak may lie in one block only, whose error is then uncertain for all structures.
            acceptable += [key] * (mean <= error and missed.issuperset(self._missed(each, best).tolist()))
        taken = min(acceptable, key=lambda key: (found[key].parameters, found[key].criterion))
        found[taken] = found[taken]._replace(taken=True)
        return tuple(found.get(id(each), each) for each in ranked)

    def _held_back(self, each: Judged, blocks: IntArray) -> Array:
        """Return the squared weighted errors of the lines, each from a fit without them; infinite if a fit fails."""
        data, whole, errors = self.data, each.options.prepare(self.data).laid_out, np.full(blocks.size, np.inf)
        assert isinstance(whole, MeasuredLines)
        for fold in range(FOLDS):
            held = blocks % FOLDS == fold
            kept = None if data.standard_error is None else data.standard_error[~held]
            part = replace(
                data, frequencies=data.frequencies[~held], response=data.response[~held], standard_error=kept
            )
            try:
                measured = each.options.prepare(part).laid_out
                assert isinstance(measured, MeasuredLines)
                model = measured.model(measured.local(measured.begin(each.fit.model)))
                squared = np.abs(complex_errors(whole, whole.errors_of(model).residuals[0])) ** 2
            except CtidError:
                return np.full(blocks.size, np.inf)
            errors[held] = 0.5 * squared[held]
        return errors

    # --- peaks -----------------------------------------------------------------------------------------

    def _missed(self, model: Judged, closest: Judged) -> IntArray:
        """Return the clear peaks that exceed a model, and at which it has no pole pair."""
        w, fit = self.lines.frequencies, model.fit
        # A model that is too small leaves large errors: the noise is that between neighbouring lines, if it is less.
        errors = self._errors(min(self.scale, float(np.sqrt(closest.fit.cost))))
        if self.data.standard_error is not None:
            errors = np.maximum(errors, self.data.standard_error)
        peaks = clear_peaks(self.data, errors)
        if not peaks.size:
            return peaks
        above = np.abs(self.data.response[peaks]) - np.abs(fit.responses_at(w)[peaks])
        pairs, gaps = fit.model.poles[fit.model.poles.imag > 0.0], np.gradient(w)[peaks]
        at = np.array(
            [np.any(np.abs(pairs.imag - w[k]) <= 2.0 * gap) for k, gap in zip(peaks, gaps, strict=True)], bool
        )
        return np.asarray(peaks[(above > MISSED * errors[peaks]) & ~at])

    def _missed_peaks(self, taken: Judged, judged: tuple[Judged, ...]) -> Iterator[str]:
        """Yield a sentence on each peak that the chosen structure does not describe, and one that does."""
        closest = min(judged, key=lambda each: (not each.admissible, each.fit.cost))
        missed = self._missed(taken, closest)
        scale = self._errors(float(np.sqrt(closest.fit.cost)))
        if self.data.standard_error is not None:
            scale = np.maximum(scale, self.data.standard_error)
        larger = sorted((one for one in judged if one.order > taken.order), key=lambda one: one.order)
        left = {one.name: set(self._missed(one, closest).tolist()) for one in larger if one.admissible}
        time, output, input_ = self.data.units
        for k in missed.tolist():
            w, size = self.lines.frequencies[k], abs(self.data.response[k])
            above = (size - abs(taken.fit.responses_at(self.lines.frequencies[[k]])[0])) / scale[k]
            if above < MISSED:
                continue
            has = next((one for one in larger if one.admissible and k not in left[one.name]), None)
            advice = "" if has is None else f"; --poles {has.options.poles} --zeros {has.options.zeros} has it"
            where = f"A peak at {w:.3g} rad/{time} (magnitude {size:.3g} {output}/{input_}"
            chosen = f"is not described by the chosen {count(taken.options.poles, 'pole')}"
            yield f"{where}, {above:.2g} standard errors above the model) {chosen}{advice}"

    # --- sentences -------------------------------------------------------------------------------------

    def _sentences(self, taken: Judged, judged: tuple[Judged, ...], noise: NoiseModel) -> Iterator[str]:
        """Yield a sentence for each choice."""
        best, time = judged[0], self.data.units[0]
        if len(judged) > 1 and taken is best:
            same = taken.options.poles, taken.options.zeros, taken.options.integrators
            others = (
                one for one in judged[1:] if (one.options.poles, one.options.zeros, one.options.integrators) != same
            )
            other = next(others, judged[1])
            fall = f"the criterion is {shown(other.criterion - best.criterion)} lower than with the runner-up"
            yield f"Structure: {taken.words}; {fall}, {other.words}."
        elif len(judged) > 1:
            fall = f"{shown(taken.criterion - best.criterion)} lower"
            error = f"{taken.difference:.2g} +- {taken.standard_error:.1g}"
            yield (
                f"Structure: {taken.words}, the smallest that predicts held-back lines as well as that of least "
                f"criterion ({fall}), {best.words}: the logarithm of the ratio of their squared errors is {error}."
            )
        if self.given.delay_bounds is None:
            yield self._about_delay(taken, judged, time)
        if self.given.poles is None and self.limit > MOST:
            yield f"Order: up to {self.limit} poles were tried instead of {MOST}, as {self.why}."
        elif self.given.poles is None and best.order >= self.limit:
            yield f"Order: at most {MOST} poles were tried (ctid order --poles 1:12 tries more)."
        white = f"whitened by an autoregressive model of order {noise.order}" if noise.order else "taken as independent"
        yield (
            f"Criterion: BIC of the weighted errors, {white}, with a free common factor of the standard errors, each "
            f"parameter counted {PENALTY:g} times."
        )

    def _about_delay(self, taken: Judged, judged: tuple[Judged, ...], time: str) -> str:
        """Describe the delay, and by how much its presence or absence is better."""
        free = taken.options.delay_bounds[1] > 0.0
        others = [one.criterion for one in judged if (one.options.delay_bounds[1] > 0.0) != free and one.admissible]
        own = min(one.criterion for one in judged if (one.options.delay_bounds[1] > 0.0) == free)
        fall = ""
        if others:
            change, other = min(others) - own, "without" if free else "with"
            fall = f"the criterion is {shown(abs(change))} {'lower' if change >= 0.0 else 'higher'} than {other} one"
        searched = f"searched from 0 to {self.reach:g} {time} (--delay), 1.5 times the slope of the phase"
        return f"Delay: {searched if free else 'none (--delay 0)'}{f'; {fall}' * bool(fall)}."


def answer_of_lines(fit: FrequencyDomainFit) -> ResponseTest:
    """Test the model against no response by the F-distribution, allowing for a peak of the noise at any line."""
    from scipy.stats import f as f_distribution

    size, spare = fit.tangent.shape[1], fit.count - fit.tangent.shape[1]
    ratio = fit.r2 / size / max((1.0 - fit.r2) / spare, 1e-300)
    chances = 0.5 * fit.count
    p_value = min(chances * float(f_distribution.sf(ratio, size, spare)), 1.0)
    least = float(f_distribution.isf(min(LEVEL / chances, 1.0), size, spare)) * size / spare
    return ResponseTest(fit.r2, least / (1.0 + least), p_value)


def _about_weights(fit: FrequencyDomainFit) -> Iterator[str]:
    """Yield that the errors of equally weighted lines grow with the gain, if they do so clearly."""
    data, gain = fit.data, np.abs(fit.responses_at(fit.data.frequencies))
    if data.standard_error is not None or data.weight != "none" or not gain.all():
        return
    squared, size = np.abs(data.response - fit.responses_at(data.frequencies)) ** 2, float(np.sum(np.log(gain)))
    values = {
        weight: gain.size * float(np.log(np.mean(squared / gain**power))) + power * size
        for weight, power in (("none", 0.0), ("inverse-sqrt", 1.0), ("inverse", 2.0))
    }
    weight = min(values, key=lambda name: values[name])
    if values[weight] < values["none"] - GROWS:
        fall = shown(2.0 * (values["none"] - values[weight]))
        what = f"with --weight {weight} the deviance of the errors is {fall} lower"
        yield f"The errors grow with the gain, and all lines have the same weight: {what}"
