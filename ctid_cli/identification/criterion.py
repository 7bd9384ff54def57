"""Comparison of candidates: by a criterion of their innovations, and by the errors of held-back blocks."""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import replace

import numpy as np

from ctid_cli.arrays import Array, BoolArray, IntArray
from ctid_cli.errors import CtidError
from ctid_cli.estimators.delay_profile import DelayProfile
from ctid_cli.estimators.measured_fit import MeasuredFit, fitted
from ctid_cli.identification.choice import Candidate, HeldBack, Ranking
from ctid_cli.inference.criteria import (
    DECISIVE,
    OWN_PENALTY,
    PENALTY,
    information_criteria,
    innovations_count,
    percent_from_r_squared,
    squared_innovations,
)
from ctid_cli.inference.noise_model import NoiseModel, fit_noise_model
from ctid_cli.inference.repetition import repetitions_of
from ctid_cli.inference.signal_features import input_moves, resolution
from ctid_cli.progress import reported
from ctid_cli.signals.noise import ArmaNoise
from ctid_cli.signals.record import Record, with_hold

#: Blocks of all records, each held back once, and least number of each record; groups of blocks that are held back
#: together.
BLOCKS, FEWEST_BLOCKS, FOLDS = 10, 2, 5
#: Share of the least mean squared error of all blocks that each of them has at least: quiet blocks do not decide.
LEAST_SHARE = 0.1
#: Standard errors above the least errors of held-back blocks up to which others are acceptable.
FARTHEST = 2.0
#: Most changes of an input whose responses are few.
FEW_RESPONSES = 5
#: Correlation of residuals one period later that chance gives, in standard deviations, and fewest pairs for it.
CHANCE, FEWEST_PAIRS = 2.0, 10


def ranked(
    candidates: Sequence[Candidate], records: Sequence[Record], group: Callable[[Candidate], Hashable] | None = None
) -> Ranking:
    """Rank candidates, fitted to the same samples, by their criterion.

    One step of generalised least squares from the fit promises a sum of squared innovations, which need not exist. The
    least one of each group is therefore computed by a search.
    """
    closest = min(candidates, key=lambda each: (not each.is_proper, each.fit.cost))
    noise = noise_of(closest.fit.residuals)
    share = independent_share(closest.fit, records)
    found = [_with_criterion(each, noise, share) for each in candidates]
    if group is not None and noise.order:
        groups: dict[Hashable, list[Candidate]] = {}
        for each in found:
            groups.setdefault(group(each), []).append(each)
        found = [each for own in groups.values() for each in _realised(own, records, noise, share)]
    return Ranking(tuple(sorted(found, key=lambda each: each.criterion)), noise)


def _with_criterion(candidate: Candidate, noise: NoiseModel, share: float, squared: float | None = None) -> Candidate:
    fit = candidate.fit
    if squared is None:
        squared = squared_innovations(fit.residuals, [psi @ fit.tangent for psi in fit.sensitivities], noise)
    count = innovations_count(fit.residuals, noise)
    criteria = information_criteria(squared, count, candidate.size)
    criterion = penalised(squared / count, share * count, candidate.size)
    return replace(candidate, criterion=criterion, criteria=criteria)


def independent_share(fit: MeasuredFit, records: Sequence[Record]) -> float:
    """Return the share of the samples of records that count if a part of their residuals repeats with the input.

    A rounding or a nonlinearity has the same error in all of P periods of the input: if a share r of the variance
    repeats, the means over periods have the variance of N / (1 + (P - 1) r) independent residuals.
    """
    repeated, periods = [], []
    for record, e, use in zip(records, fit.residuals, fit.used, strict=True):
        step, found = record.interval, () if record.several else repetitions_of(record.input, record.t)
        if step is None or not found or not e.any():
            return 1.0
        shift = min(found, key=lambda each: each.shift)
        lag, whole = round(shift.shift / step), np.full(use.size, np.nan)
        whole[use] = e
        pairs = shift.sign * whole[lag:] * whole[: whole.size - lag]
        pairs = pairs[np.isfinite(pairs)]
        if pairs.size < FEWEST_PAIRS:
            return 1.0
        repeated.append(float(np.mean(pairs) / np.mean(e**2)) - CHANCE / np.sqrt(pairs.size))
        periods.append(e.size / lag)
    return 1.0 / (1.0 + (float(np.mean(periods)) - 1.0) * max(float(np.mean(repeated)), 0.0))


def _realised(
    candidates: Sequence[Candidate], records: Sequence[Record], noise: NoiseModel, share: float
) -> list[Candidate]:
    """Return candidates of which the least criterion is that of a model."""
    promised, found = sorted(candidates, key=lambda each: each.criterion, reverse=True), list[Candidate]()
    while promised and (not found or promised[-1].criterion < min(each.criterion for each in found)):
        each = promised.pop()
        found.append(_with_criterion(each, noise, share, _innovations(each, records, noise)))
    return found + promised


def _innovations(candidate: Candidate, records: Sequence[Record], noise: NoiseModel) -> float:
    """Return the sum of squared innovations of the generalised least-squares estimate in the basin of a fit."""
    fit, own = candidate.fit, tuple(noise.coefficients.tolist())

    def squared(errors: Sequence[Array]) -> float:
        return sum(float(np.sum(noise.innovations(e)[noise.order :] ** 2)) for e in errors)

    at_fit = squared(fit.residuals)
    laid_out = candidate.options.prepare([with_hold(record, candidate.hold) for record in records]).laid_out
    try:
        white = laid_out.whitened_by(ArmaNoise((1.0,), own, innovation_variance=1.0))
        return min(squared(white.errors(white.local(white.begin(fit.parametrised)))), at_fit)
    except (CtidError, np.linalg.LinAlgError):
        # The fit itself is such a model.
        return at_fit


def criteria_of(
    models: Sequence[Sequence[Array]], used: Sequence[Sequence[BoolArray]], parameters: Sequence[int]
) -> list[float]:
    """Return the criterion of output errors at the samples that all models use, with the noise of the least ones."""
    common = [np.logical_and.reduce(uses) for uses in zip(*used, strict=True)]
    kept = [
        [e[mask[use]] for e, mask, use in zip(errors, common, own, strict=True)]
        for errors, own in zip(models, used, strict=True)
    ]
    noise = noise_of(min(kept, key=lambda errors: sum(float(e @ e) for e in errors)))
    return [
        penalised(squared / count, count, size)
        for squared, count, size in zip(
            (squared_innovations(errors, [np.zeros((e.size, 0)) for e in errors], noise) for errors in kept),
            (innovations_count(errors, noise) for errors in kept),
            parameters,
            strict=True,
        )
    ]


def noise_of(residuals: Sequence[Array]) -> NoiseModel:
    """Return the autoregressive model of residuals with the least BIC."""
    return fit_noise_model(residuals, penalty=float(np.log(sum(block.size for block in residuals))))


def penalised(mean_square: float, count: float, parameters: int, penalty: float = PENALTY) -> float:
    """Return the criterion of a number of innovations with a mean square."""
    logarithm = float(np.log(max(mean_square, np.finfo(float).tiny)))
    return count * logarithm + penalty * parameters * float(np.log(count))


# --- held-back blocks ----------------------------------------------------------------------------------


def judged(ranking: Ranking, records: Sequence[Record]) -> tuple[Ranking, Candidate]:
    """Return candidates with the errors of held-back blocks of the best one of each order, and the one to take."""
    proper = [each for each in ranking.candidates if each.is_proper] or list(ranking.candidates)
    best, first = proper[0], dict[Hashable, Candidate]()
    for each in proper:
        first.setdefault(each.structure, each)
    tried = [best, *(each for each in first.values() if each.size < best.size)]
    found = {id(each): each for each in ranking.candidates}
    if len(tried) > 1:
        compared = held_back([(each, records) for each in tried])
        found |= {id(each): replace(each, held_back=own) for each, own in zip(tried, compared, strict=True)}
    accepted = [own for each in tried if (own := found[id(each)]).held_back is not None and own.held_back.acceptable]
    taken = min(accepted, key=lambda each: (each.size, each.criterion), default=best)
    if few_changes(records):
        taken = found[id(after_few_changes(list(first.values()), taken.options.integrators))]
    return replace(ranking, candidates=tuple(found[id(each)] for each in ranking.candidates)), taken


def few_changes(records: Sequence[Record]) -> bool:
    """Return whether all inputs change only a few times."""
    moves = [input_moves(each) for record in records for each in record.each_input]
    return all(one.kind != "continuous" and one.changes.size <= FEW_RESPONSES for one in moves)


def after_few_changes(candidates: Sequence[Candidate], integrators: int) -> Candidate:
    """Return the candidate of least own criterion, with the number of integrators that held-back blocks decide on.

    The blocks of a few responses do not tell the order of a model. With an estimated state an integrator may also be a
    drift, unless the evidence is very strong.
    """
    without, with_one = (
        min((each for each in candidates if bool(each.options.integrators) is some), key=own_criterion, default=None)
        for some in (False, True)
    )
    if without is None or with_one is None:
        return min(candidates, key=own_criterion)
    if candidates[0].options.initial_state == "estimate":
        integrators = int(own_criterion(with_one) < own_criterion(without) - DECISIVE)
    return with_one if integrators else without


def own_criterion(candidate: Candidate) -> float:
    """Return a criterion with the noise model of the candidate itself and a greater penalty.

    After a few steps a disturbance is like the response of further poles. A model common to all candidates is that of
    the largest, which follows the disturbance, so that the smaller ones seem to miss a response.
    """
    fit, noise = candidate.fit, noise_of(candidate.fit.residuals)
    none = [np.zeros((e.size, 0)) for e in fit.residuals]
    count = innovations_count(fit.residuals, noise)
    return penalised(squared_innovations(fit.residuals, none, noise) / count, count, candidate.size, OWN_PENALTY)


@reported("held-back blocks")
def held_back(candidates: Sequence[tuple[Candidate, Sequence[Record]]]) -> list[HeldBack | None]:
    """Return the errors of held-back blocks of models fitted to the same outputs, None where a fit fails.

    They are acceptable if they are not larger than those of the first model by more than a standard error, nor than the
    least ones by more than two.
    """
    used = [np.logical_and.reduce(uses) for uses in zip(*(each.fit.used for each, _ in candidates), strict=True)]
    blocks = block_numbers(used)
    errors = [_block_errors(each, records, blocks) for each, records in candidates]
    outputs = [record.y[use] for record, use in zip(candidates[0][1], used, strict=True)]
    if errors[0] is None:
        return [None] * len(errors)
    steps = [resolution(y) ** 2 / 12 for y in outputs]
    least = LEAST_SHARE * min(float(squared.mean()) for squared in errors if squared is not None)
    smallest = np.maximum(np.repeat(steps, _blocks_each(used)), least)
    sizes = [None if squared is None else np.log(np.maximum(squared, smallest)) for squared in errors]
    lowest = min((size for size in sizes if size is not None), key=lambda size: float(size.mean()))
    total = float(np.mean(np.concatenate([y - y.mean() for y in outputs]) ** 2))
    found: list[HeldBack | None] = []
    for squared, size in zip(errors, sizes, strict=True):
        if squared is None or size is None or sizes[0] is None:
            found.append(None)
            continue
        percent = percent_from_r_squared(1.0 - float(squared.mean()) / total)
        first, least_ones = (difference(size, other) for other in (sizes[0], lowest))
        acceptable = first[0] <= first[1] and least_ones[0] <= FARTHEST * least_ones[1]
        found.append(HeldBack(percent, *first, acceptable))
    return found


def difference(one: Array, other: Array) -> tuple[float, float]:
    """Return the mean difference of the errors of blocks and its standard error."""
    ratios = one - other
    return float(ratios.mean()), float(ratios.std(ddof=1) / np.sqrt(ratios.size))


def block_numbers(used: Sequence[BoolArray]) -> list[IntArray]:
    """Return the number of the block of each sample of each record, -1 for samples that are never held back.

    These are the first used ones, from which the initial state is estimated.
    """
    found = []
    for use in used:
        numbers = np.full(use.size, -1)
        count = int(np.count_nonzero(use))
        numbers[use] = np.arange(count) * (_blocks_each(used) + 1) // max(count, 1) - 1
        found.append(numbers)
    return found


def _blocks_each(records: Sequence[object]) -> int:
    return max(FEWEST_BLOCKS, -(-BLOCKS // len(records)))


def _block_errors(candidate: Candidate, records: Sequence[Record], blocks: Sequence[IntArray]) -> Array | None:
    """Return the mean squared errors of all blocks; None if a fit fails."""
    try:
        errors = held_back_errors(candidate, records, blocks)
    except CtidError:
        return None
    pairs = [
        (own, numbers == k) for own, numbers in zip(errors, blocks, strict=True) for k in range(_blocks_each(blocks))
    ]
    squared = np.array([float(np.mean(own[at] ** 2)) if at.any() else np.nan for own, at in pairs])
    return squared if np.isfinite(squared).all() else None


def held_back_errors(candidate: Candidate, records: Sequence[Record], blocks: Sequence[IntArray]) -> list[Array]:
    """Return the errors of all blocks, each from a fit without its outputs; NaN elsewhere, shape (N,) each.

    Input and state are simulated through a held-back block. Fits start at that to the whole records. The last group of
    blocks that are held back together has the ends of all records.
    """
    options, each = candidate.options, _blocks_each(blocks)
    last = each - -(-each // FOLDS)
    whole = options.prepare(records).laid_out
    errors = [np.full(record.n_samples, np.nan) for record in records]
    for number in range(FOLDS):
        held = [
            (own >= 0) & (np.where(own >= last, FOLDS - 1, (own + k * each) % (FOLDS - 1)) == number)
            for k, own in enumerate(blocks)
        ]
        if not any(out.any() for out in held):
            continue
        pairs = zip(records, held, strict=True)
        fit = refitted(candidate, [replace(record, y=np.where(out, np.nan, record.y)) for record, out in pairs]).fit
        outputs = options._simulated(fit, whole), whole.used(), fit.offsets
        for error, out, record, simulated, use, offset in zip(errors, held, records, *outputs, strict=True):
            known = np.full(record.n_samples, np.nan)
            known[use] = record.y[use] - simulated - (offset if options.offset == "remove" else 0.0)
            error[out] = known[out]
    return errors


def refitted(candidate: Candidate, records: Sequence[Record]) -> Candidate:
    """Return a candidate fitted to other records, near its model."""
    options = candidate.options
    laid_out = options.prepare(records).laid_out
    if isinstance(options, DelayProfile) and options.bounds:
        return replace(candidate, fit=options._minimum(laid_out, None))
    return replace(candidate, fit=fitted(laid_out, laid_out.local(laid_out.begin(candidate.fit.parametrised)), None))
