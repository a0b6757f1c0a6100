"""What the terms of a model prove about all of its runs: no negative state, nothing unbounded."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linprog

from ep2sindy.library.names import factors_of
from ep2sindy.model.model import SparseModel

NONNEGATIVE = "no state can turn negative: every term that lowers one contains it"
BOUNDED = "every run stays bounded: what states exchange is conserved, and all of them leave"
CERTAIN = 1e-6  # least fraction of a term that must be left over for a proof, far above rounding


def consequences(model: SparseModel) -> list[str]:
    """What holds for every run that starts from nonnegative states, by the terms alone.

    None of it holds for a model with inputs, or with other functions than products of states.
    """
    factors = [factors_of(name) if name != "1" else {} for name in model.library.names]
    used = np.flatnonzero(model.coef.any(axis=1))
    plain = all(factors[k] or model.library.names[k] == "1" for k in used)
    if model.inputs or not plain or not _keeps_sign(model, factors):
        return []
    return [NONNEGATIVE, *([BOUNDED] if _is_bounded(model, factors) else [])]


def _keeps_sign(model: SparseModel, factors: list[dict[str, int]]) -> bool:
    """Whether every term with a negative coefficient contains the state that it lowers."""
    lowering = zip(*np.nonzero(model.coef < 0.0), strict=True)
    return all(model.states[column] in factors[term] for term, column in lowering)


def _is_bounded(model: SparseModel, factors: list[dict[str, int]]) -> bool:
    """Whether a weighted sum of the states can only fall, but for a constant, and by each of them.

    Weights of one or more are sought by which no term raises the sum, and which leave of the powers
    of every state something that lowers it. Then the sum's rate is at most a constant less these
    powers, and the sum stays below a bound.
    """
    size = np.abs(model.coef).max(axis=1)
    terms = [k for k in np.flatnonzero(size) if factors[k]]
    rates = model.coef[terms] / size[terms, None]  # of the sum by each term, a weight per column
    own = np.array([[set(factors[k]) == {s} for k in terms] for s in model.states], dtype=float)
    n_states = len(model.states)
    # Unknown: the weights, and the least that is left over of the powers of a state.
    above = np.block([[rates, np.zeros((len(terms), 1))], [own @ rates, np.ones((n_states, 1))]])
    cost = np.append(np.zeros(n_states), -1.0)
    limits = [(1.0, 1.0 / CERTAIN)] * n_states + [(0.0, 1.0)]
    found = linprog(cost, A_ub=above, b_ub=np.zeros(len(above)), bounds=limits)
    return bool(found.status == 0 and found.x[-1] > CERTAIN)
