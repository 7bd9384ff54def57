"""Output errors of held-back blocks of the records, to compare two fits of the same records."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ctid_cli.arrays import Array, IntArray
from ctid_cli.errors import CtidError
from ctid_cli.estimation.optimum.best_model import Begin
from ctid_cli.estimators.additive_output_error import AdditiveOutputError
from ctid_cli.estimators.delay_profile import DelayProfile
from ctid_cli.identification.criterion import Candidate, Ranking, in_order
from ctid_cli.inference.criteria import percent_from_r_squared
from ctid_cli.progress import reported
from ctid_cli.signals.record import Record

#: Blocks of all records, each held back once, and groups of blocks that are held back together: the last group has the
#: ends of the records. The standard error of ten differences has a relative error of 24 %.
BLOCKS, FOLDS = 10, 5
#: Fewest blocks of a record.
FEWEST_BLOCKS = 2
#: Fits are not compared if a block has fewer samples, or the input moves in a smaller fraction of the blocks.
SHORTEST, MOVING = 20, 0.8
#: Smaller differences of two fits are ignored [%].
WORTHWHILE = 0.3
#: A structure has at least three samples for each parameter. If it describes the record, its mean squared error of
#: held-back blocks is then at most (1 + 1/3) / (1 - 1/3) of that of its fit.
OPTIMISTIC = 2.0


@dataclass(frozen=True)
class Gain:
    """Improvement of one fit over another."""

    #: Fit of both [%], and standard error of their difference [%].
    before: float
    after: float
    standard_error: float
    #: Mean over the blocks in its standard errors [-], the greater of two: that of the decreases of their squared
    #: errors, and that of the logarithms of the ratios, in which blocks of different size count equally.
    score: float
    #: Ratio of the squared errors at the end of the records, where a fit extrapolates [-].
    end: float

    @property
    def helps(self) -> bool:
        """Whether the difference is not negligible, and more than two standard errors."""
        return self.after - self.before > WORTHWHILE and self.score > 2.0


def block_numbers(records: Sequence[Record]) -> list[IntArray]:
    """Return the number of each sample's block, -1 at the beginning of a record, which is never held back.

    The initial state is estimated from it.
    """
    each = _blocks_each(records)
    return [np.arange(record.n_samples) * (each + 1) // record.n_samples - 1 for record in records]


def _blocks_each(records: Sequence[Record]) -> int:
    return max(FEWEST_BLOCKS, -(-BLOCKS // len(records)))


def _folds(records: Sequence[Record]) -> list[IntArray]:
    """Return the group in which each sample is held back, -1 for none; the last one has the ends of all records."""
    each = _blocks_each(records)
    last = each - -(-each // FOLDS)
    found = []
    for k, blocks in enumerate(block_numbers(records)):
        fold = np.where(blocks >= last, FOLDS - 1, (blocks + k * each) % (FOLDS - 1))
        found.append(np.where(blocks >= 0, fold, -1))
    return found


def long_enough(records: Sequence[Record]) -> bool:
    """Return whether blocks have enough samples, and the input moves in most of them."""
    moving = []
    for record, numbers in zip(records, block_numbers(records), strict=True):
        for block in range(_blocks_each(records)):
            inside = numbers == block
            if np.count_nonzero(inside & record.valid) < SHORTEST:
                return False
            moving.append(any(np.ptp(signal.at(record.t[inside])) > 0.0 for signal in record.held.values()))
    return float(np.mean(moving)) >= MOVING


def held_back_errors(options: DelayProfile, records: Sequence[Record], near: Begin) -> list[Array]:
    """Return the output errors of all blocks, each from a fit without its outputs; NaN elsewhere, each of shape (N,).

    Input and state are simulated through a held-back block. Fits start at that to the whole records.
    """
    whole, folds = options.prepare(records).laid_out, _folds(records)
    errors = [np.full(record.n_samples, np.nan) for record in records]
    for number in range(FOLDS):
        held = [fold == number for fold in folds]
        each = zip(records, held, strict=True)
        fit = options._refine([replace(record, y=np.where(out, np.nan, record.y)) for record, out in each], near)
        outputs = options._simulated(fit, whole), whole.used(), fit.offsets
        for error, out, record, simulated, use, offset in zip(errors, held, records, *outputs, strict=True):
            known = np.full(record.n_samples, np.nan)
            known[use] = record.y[use] - simulated - (offset if options.offset == "remove" else 0.0)
            error[out] = known[out]
    return errors


@reported("structures on held-back samples")
def without_overfitted(ranking: Ranking, records: Sequence[Record]) -> Ranking:
    """Return structures in order, those last that are too large to predict held-back blocks.

    The best structure of each number of poles is checked: it is overfitted if its ratio of the squared error of
    held-back blocks to that of its fit exceeds the ratio of a smaller structure by a factor that no number of
    parameters explains. Sums of submodels, and models of several inputs, are not checked.
    """
    if any(isinstance(each.options, AdditiveOutputError) for each in ranking.candidates) or records[0].several:
        return ranking
    best_of: dict[int, Candidate] = {}
    for each in ranking.candidates:
        if each.is_admissible and each.options.order <= ranking.best.options.order:
            best_of.setdefault(each.options.order, each)
    if len(best_of) < 2 or not long_enough(records):
        return ranking
    checked = {
        order: replace(each, prediction_ratio=_prediction_ratio(each, records)) for order, each in best_of.items()
    }
    most = ranking.best.options.order
    while smaller := [each for order, each in checked.items() if order < most]:
        if not checked[most].prediction_ratio > OPTIMISTIC * min(each.prediction_ratio for each in smaller):
            break
        most = min(smaller, key=lambda each: each.criterion).options.order
    replaced = {id(each): checked[order] for order, each in best_of.items()}
    found = [replaced.get(id(each), each) for each in ranking.candidates]
    return replace(ranking, candidates=in_order([replace(each, predicts=each.options.order <= most) for each in found]))


def _prediction_ratio(candidate: Candidate, records: Sequence[Record]) -> float:
    """Return the mean squared error of held-back blocks over that of the fit; infinity if a fit fails."""
    options, fit = candidate.options, candidate.fit
    assert isinstance(options, DelayProfile)
    try:
        near = fit.model.denominator[: fit.model.denominator.size - options.integrators], fit.model.delay
        errors = np.concatenate(held_back_errors(options, records, near))
    except CtidError:
        return float("inf")
    return float(np.nanmean(errors**2)) / max(fit.cost, np.finfo(float).tiny)


def compared(before: Sequence[Array], after: Sequence[Array], records: Sequence[Record]) -> Gain:
    """Compare two fits by their errors at the same samples, NaN at all others.

    The standard error of a difference of fits is, to first order, that of the mean decrease of a block's squared error,
    or of the mean logarithm of the ratio of both, whichever is more significant.
    """
    sums: list[Array] = []
    total, end = 0.0, np.zeros(2)
    each = zip(before, after, records, block_numbers(records), _folds(records), strict=True)
    for first, second, record, blocks, folds in each:
        both = np.isfinite(first) & np.isfinite(second)
        y, pair = record.y[both], np.array([first[both], second[both]]) ** 2
        total += float(np.sum((y - y.mean()) ** 2))
        sums += [pair[:, blocks[both] == block].sum(axis=1) for block in range(_blocks_each(records))]
        end += pair[:, folds[both] == FOLDS - 1].sum(axis=1)
    squared = np.array(sums)
    worse, better = (percent_from_r_squared(1.0 - one / total) for one in squared.sum(axis=0).tolist())
    squared = squared[(squared > 0.0).all(axis=1)]
    score = max(_score(squared[:, 0] - squared[:, 1]), _score(np.log(squared[:, 0] / squared[:, 1])))
    error = (better - worse) / score if score > 0.0 else float("inf")
    return Gain(worse, better, error, score, float(end[1] / end[0]) if end[0] > 0.0 else float("inf"))


def _score(values: Array) -> float:
    """Return the mean of values over its standard error."""
    error = float(np.std(values, ddof=1) / np.sqrt(values.size)) if values.size > 1 else 0.0
    return float(values.mean()) / error if error > 0.0 else 0.0
