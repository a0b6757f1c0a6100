"""Choice of supports of all equations, from one Gram matrix and the penalties of the terms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ep2sindy.data.numbers import zero_to_one
from ep2sindy.estimation.likelihood import Gram, within_bounds
from ep2sindy.estimation.problem import ByCoefficient, EstimationProblem, Support
from ep2sindy.regression.gram_kernels import DEPENDENT, fit_masks, invert_gram
from ep2sindy.regression.searches import exchange_terms, find_best_subsets

MAX_SWEEPS = 10  # over the equations; two or three usually suffice
# Weight of the cost of choosing among terms. Below 0.5 there are more false terms than true ones
# are gained, above 1 the reverse: `python -m benchmarks.estimation penalties`.
GAMMA = 1.0
PROVEN_TERMS = 7  # of one equation; larger supports are the best that exchanges find
# Multiplications for a proof, some milliseconds. A choice is made a hundred times on the way, and
# where a proof takes longer, exchanges from the best so far find nearly always the same.
MOST_WORK = 3e6
N_BEST = 4  # supports of each size of an equation, since terms of one size differ in penalty
MAX_ALTERNATIVES = 24  # supports of one equation for which the others are searched again


@dataclass(frozen=True, eq=False)
class PenalisedFit:
    """A support, the best free coefficients on it, and its squares plus the penalties."""

    support: Support
    free: ByCoefficient
    score: float


def term_penalties(problem: EstimationProblem, n_samples: float) -> ByCoefficient:
    """Penalty of each coefficient: the fall of the squares that justifies it.

    The penalty is log n plus a cost of choosing among terms. A term of degree q is one of d C(d +
    q, q), and every degree above the first is half as likely a priori as the one below; a constant
    is no simpler than a variable. Source: Schwarz 1978, doi:10.1214/aos/1176344136, for log n; Chen
    & Chen 2008, doi:10.1093/biomet/asn034, for the count.
    """
    degrees = np.maximum(problem.degrees, 1)
    every = problem.candidates.degrees
    counts = np.array([(every <= degree).sum() for degree in degrees])
    return np.log(n_samples) + 2.0 * GAMMA * np.log(counts) + 2.0 * np.log(2.0) * (degrees - 1)


def best_support(
    problem: EstimationProblem,
    gram: Gram,
    penalties: ByCoefficient,
    start: Support,
    *,
    held: int | None = None,
) -> PenalisedFit:
    """The support of least score, by sweeps over the equations until none changes.

    Each equation's support is found exactly, given the others'. Required terms are
    always in. held: an equation that is not changed.
    """

    def rank(each: PenalisedFit) -> tuple[int, int, float]:
        negative = int((each.free[problem.positive] < 0.0).sum())
        return negative, excess(problem, each.support), each.score

    best = penalise(gram, start, penalties)
    for _ in range(MAX_SWEEPS):
        before = best
        for block in np.unique(problem.block):
            own = problem.block == block
            if block == held or problem.required[own].all():
                continue
            offered = offer_supports(problem, gram, penalties, best.support, own)
            first = min(offered, key=lambda each: each.score)
            best = min([best, penalise(gram, first.support, penalties)], key=rank)
        if best is before:
            return best
    return best


def excess(problem: EstimationProblem, support: Support) -> int:
    """Number of terms above the most allowed, over all equations, required terms not counted."""
    sizes = np.bincount(problem.block[support & ~problem.required], minlength=1)
    return int(np.maximum(sizes - problem.max_terms, 0).sum())


def alternatives(
    problem: EstimationProblem,
    gram: Gram,
    penalties: ByCoefficient,
    chosen: Support,
    *,
    within: float,
) -> list[PenalisedFit]:
    """Supports whose score lies no further than `within` above the chosen one's, best first.

    Each takes another support of one equation, and the best ones of the others given that. So they
    include exchanges in two equations that pay only together.
    """
    limit = penalise(gram, chosen, penalties).score + within
    found: dict[bytes, PenalisedFit] = {}
    for block in np.unique(problem.block).tolist():
        offered = offer_supports(problem, gram, penalties, chosen, problem.block == block)
        near = [
            each
            for each in sorted(offered, key=lambda each: each.score)
            if each.score <= limit + within and not np.array_equal(each.support, chosen)
        ]
        for other in near[:MAX_ALTERNATIVES]:
            each = best_support(problem, gram, penalties, other.support, held=block)
            if each.score <= limit and excess(problem, each.support) == 0:
                found[each.support.tobytes()] = each
    found.pop(chosen.tobytes(), None)
    return sorted(found.values(), key=lambda each: each.score)


def penalise(gram: Gram, support: Support, penalties: ByCoefficient) -> PenalisedFit:
    """Least squares on a support, and their score: the squares plus its terms' penalties."""
    free = np.zeros(len(support))
    quadratic, linear = gram.quadratic[np.ix_(support, support)], gram.linear[support]
    inverse = invert_gram(quadratic)
    free[support] = inverse @ linear
    # One step of iterative refinement; directions below the cutoff stay out.
    free[support] += inverse @ (linear - quadratic @ free[support])
    rest = gram.offset - 2.0 * gram.linear @ free + free @ gram.quadratic @ free
    return PenalisedFit(support, free, float(rest + penalties[support].sum()))


class Proposals(NamedTuple):
    """A support, and the squares that it leaves plus the penalties of its terms."""

    support: Support
    score: float


def offer_supports(
    problem: EstimationProblem, gram: Gram, penalties: ByCoefficient, chosen: Support, own: Support
) -> list[Proposals]:
    """The best few supports of every size of one equation, the other equations as chosen.

    Their coefficients and required ones stay free. own: mask of the equation's coefficients.
    """
    kept = (chosen & ~own) | problem.required
    own = own & ~problem.required
    either = kept | own
    rest = gram.select(either).minimise(kept[either])
    xx, xy, yy = rest.quadratic, rest.linear, max(rest.offset, 1.0)
    if not own.any():
        return [Proposals(kept, yy + penalties[kept].sum())]
    # A column that the kept ones span leaves only rounding: it is not available.
    square = np.diag(xx).copy()
    square[~(square > DEPENDENT * np.abs(np.diag(gram.quadratic)[own]))] = 0.0
    size = np.sqrt(zero_to_one(square))
    at_hand = square > 0.0
    unit = np.where(at_hand[:, None] & at_hand, xx / np.outer(size, size), 0.0)
    target = np.where(at_hand, xy / size, 0.0)
    problem_of_one = unit[None], (target / np.sqrt(yy))[None], np.ones(1)
    max_terms, n_own = problem.max_terms, int(own.sum())
    masks, proven = find_best_subsets(
        *problem_of_one,
        max_terms=min(max_terms, PROVEN_TERMS, n_own),
        n_best=N_BEST,
        most_work=MOST_WORK,
    )
    if not proven or min(max_terms, n_own) > PROVEN_TERMS:
        masks = exchange_terms(*problem_of_one, max_terms=max_terms, n_best=N_BEST, known=masks)
    found = []
    for mask, gain in zip(masks, _gains(unit, target, masks), strict=True):
        support = kept.copy()
        support[own] = mask
        found.append(Proposals(support, yy - gain + penalties[support].sum()))
    return _admit(problem, gram, penalties, found) if problem.positive.any() else found


def _admit(
    problem: EstimationProblem, gram: Gram, penalties: ByCoefficient, offered: Sequence[Proposals]
) -> list[Proposals]:
    """The supports on which coefficients that must be positive are.

    One that has negative ones is replaced by what least squares with bounds leaves of it.
    """
    found = {}
    for each in offered:
        support = each.support
        if (penalise(gram, support, penalties).free[problem.positive] < 0.0).any():
            own, quadratic = np.flatnonzero(support), gram.quadratic[np.ix_(support, support)]
            kept = within_bounds(quadratic, gram.linear[support], problem.positive[support])
            support = np.isin(np.arange(len(support)), own[kept])
            each = Proposals(support, penalise(gram, support, penalties).score)
        found[support.tobytes()] = each
    return list(found.values())


def _gains(
    unit: Float[np.ndarray, "own own"],
    target: Float[np.ndarray, " own"],
    masks: Bool[np.ndarray, "supports own"],
) -> Float[np.ndarray, " supports"]:
    """Fall of the squares by each support."""
    gains = fit_masks(unit, target, masks) @ target
    for k in np.flatnonzero(np.isnan(gains)):  # dependent terms explain what is left without them
        y, mask = target[masks[k]], masks[k]
        gains[k] = y @ invert_gram(unit[np.ix_(mask, mask)]) @ y
    return gains
