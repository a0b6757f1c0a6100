"""Search for systems of equations under roles: processes enter all of their equations or none."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import compress

import numpy as np
from jaxtyping import Bool, Float, Int

from ep2sindy.data.coerce import DiscoveryProblem
from ep2sindy.data.numbers import column_norms
from ep2sindy.library.relations import Place, Process
from ep2sindy.library.roles import Roles, constraint_of, process_matrix
from ep2sindy.regression.constrained import MIN_RESIDUAL
from ep2sindy.regression.front import ParetoFront, fit_supports
from ep2sindy.regression.gram_kernels import ROUNDING, fit_masks
from ep2sindy.regression.least_squares import LeastSquares
from ep2sindy.regression.rows import RegressionRows
from ep2sindy.regression.searches import BestSubset, Search
from ep2sindy.selection.systems import Systems, TrialSystem, find_broken_demands

Asked = tuple[DiscoveryProblem, Sequence[RegressionRows]]  # the runs of a point, and their rows
Chosen = Bool[np.ndarray, " processes"]


def search_conserving_systems(
    points: Sequence[Asked], search: Search, *, depth: int
) -> list[Systems]:
    """The systems that a search proposes for all equations at once, smallest first.

        minimise sum over equations e of |y_e - X_e (A_e z + d_e)|^2 / s_e^2 over supports of z

    z holds one amount per process, and column p of A_e its factor in every term of equation e,
    d_e what is known. So a search proposes processes, and what they move is conserved exactly. s_e
    is the standard deviation of what the whole library leaves of y_e; assumes residuals that are
    independent between rows and equations. Of several operating points the product of these sums
    is minimised, with one support for all and amounts for each. Of every size, the `depth` best
    systems are kept in which every role is played by a process, and those that must be positive
    are, at every point: least squares with these bounds would put another to zero, which is a
    smaller system. points: with the roles of each as its facts, and rows of the task's library with
    the terms of known equations, `with_known_terms`. Returns the systems of each point, in one
    order. Raises ValueError for roles that do not fit the task, or if no system plays them all.
    Called by `ep.discover(run, library.with_roles(roles), method)` for a method such as
    ep.Regression(selection=ep.FreeRunScore()); docs/roles.md shows what comes of it.
    """
    joined = [_JoinedRows.of(*point) for point in points]
    processes = joined[0].processes
    masks = _propose(joined, search)
    complete = _keep_complete(masks, processes, joined[0].roles.names)
    # By point, support and process, of columns of unit norm.
    coef = np.array([fit_masks(rows.xx, rows.xy, complete) for rows in joined])
    left = [1.0 - each @ rows.xy / rows.yy for each, rows in zip(coef, joined, strict=True)]
    errors = np.log(np.maximum(left, ROUNDING)).mean(axis=0)
    # The smallest come first, of a size by their residual.
    order = np.lexsort([*~complete.T[::-1], errors, complete.sum(axis=1)])
    independent = order[np.isfinite(coef[:, order]).all(axis=(0, 2))]
    admissible = [
        k
        for k in independent
        if not any(rows.broken(complete[k], own[k]) for rows, own in zip(joined, coef, strict=True))
    ]
    kept = _keep_first(admissible or independent.tolist(), complete.sum(axis=1), depth)
    systems = [
        [system for k in kept if (system := rows.system(complete[k], own[k])) is not None]
        for rows, own in zip(joined, coef, strict=True)
    ]
    if not systems[0]:
        raise ValueError(
            f"no system of up to {masks.sum(axis=1).max(initial=0)} terms plays all of the roles "
            f"{list(dict.fromkeys(process.role for process in processes))}: raise the search's "
            "max_terms or n_best, or give fewer roles"
        )
    pairs = zip(systems, joined, strict=True)
    return [_add_fronts(own, rows.problems, rows.task) for own, rows in pairs]


@dataclass(frozen=True, eq=False)
class _JoinedRows:
    """Rows of all equations of a point, with one column per process; what is known is subtracted.

    norms: of the columns, which are of unit norm in xx and xy. means: of the term of every process
    over the records, if roles must go forward in the mean.
    """

    task: DiscoveryProblem
    problems: Sequence[RegressionRows]
    roles: Roles
    processes: Sequence[Process]
    norms: Float[np.ndarray, " processes"]
    xx: Float[np.ndarray, "processes processes"]
    xy: Float[np.ndarray, " processes"]
    yy: float
    means: Float[np.ndarray, " processes"] | None

    @staticmethod
    def of(task: DiscoveryProblem, problems: Sequence[RegressionRows]) -> _JoinedRows:
        roles = task.facts.roles
        assert roles is not None
        processes = roles.processes(task.library, task.states)
        task = replace(task, library=task.library.with_known_terms(task.states))
        columns, target = _join_rows(problems, task, processes, roles.known)
        norms = column_norms(columns)
        unit = columns / norms
        terms = [task.library.index(process.term) for process in processes]
        means = task.theta.mean(axis=0)[terms] if roles.forward else None
        products = unit.T @ unit, unit.T @ target, float(target @ target)
        return _JoinedRows(task, problems, roles, processes, norms, *products, means)

    def broken(self, mask: Chosen, coef: Float[np.ndarray, " processes"]) -> list[str]:
        """The demands that the chosen processes do not meet. coef: by columns of unit norm."""
        means = None if self.means is None else self.means[mask]
        own = list(compress(self.processes, mask))
        return find_broken_demands(own, (coef / self.norms)[mask], means)

    def system(self, mask: Chosen, coef: Float[np.ndarray, " processes"]) -> TrialSystem | None:
        """The system of these processes; None if its coefficients do not tell them apart."""
        task, roles, own = self.task, self.roles, list(compress(self.processes, mask))
        held = constraint_of(task.library, task.states, own, roles.known_processes)
        if held is None:
            return None
        fixed = np.array([roles.known.get(held.coefficients[k], 0.0) for k in held.free])
        free = process_matrix(held) @ (coef / self.norms)[mask] + fixed
        return TrialSystem.of(task, held, free, None if self.means is None else self.means[mask])


def _propose(joined: Sequence[_JoinedRows], search: Search) -> Bool[np.ndarray, "_ processes"]:
    """Supports by the search, which one for several points must weigh together."""
    if len(joined) == 1:
        (one,) = joined
        return search.supports(one.xx, one.xy, one.yy)
    assert isinstance(search, BestSubset)  # `check_shared` refuses others
    xx, xy, yy = (np.array([getattr(rows, key) for rows in joined]) for key in ("xx", "xy", "yy"))
    return search.shared_supports(xx, xy, yy)


def _join_rows(
    problems: Sequence[RegressionRows],
    task: DiscoveryProblem,
    processes: Sequence[Process],
    known: Mapping[Place, float],
) -> tuple[Float[np.ndarray, "rows processes"], Float[np.ndarray, " rows"]]:
    """Rows of all equations, with one column per process; what is known is subtracted.

    An equation's rows are divided by what a fit of the whole library leaves of its target, so that
    no equation counts for its units.
    """
    library, columns, targets = task.library, [], []
    for problem in problems:
        for k, state in enumerate(problem.equations):
            factors = np.array(
                [[p.factors.get((state, term), 0.0) for p in processes] for term in library.names]
            )
            if not factors.any():
                continue  # the whole equation is known
            fixed = np.array([known.get((state, term), 0.0) for term in library.names])
            target = problem.scaled_target(k)
            theta = problem.train_theta
            left = target - theta @ LeastSquares.of_rows(theta, target).coef
            std = max(float(left.std()), MIN_RESIDUAL * float(np.sqrt(np.square(target).mean())))
            theta = theta / problem.coef_scale(k) / std
            columns.append(theta @ factors)
            targets.append(target / std - theta @ fixed)
    return np.concatenate(columns), np.concatenate(targets)


def _keep_complete(
    masks: Bool[np.ndarray, "supports processes"], processes: Sequence[Process], given: set[str]
) -> Bool[np.ndarray, "_ processes"]:
    """The supports in which every role that is given is played, and no equation is empty."""
    named = {process.role for process in processes}
    roles = [role for role in named if role in given or role.endswith(" free")]
    played = [np.any(masks[:, [p.role == role for p in processes]], axis=1) for role in roles]
    return masks[np.all(played, axis=0)]


def _keep_first(supports: Sequence[int], sizes: Int[np.ndarray, " _"], depth: int) -> list[int]:
    """The first supports of every size. supports: sorted by size."""
    own = [int(sizes[k]) for k in supports]
    return [each for k, each in enumerate(supports) if k - own.index(own[k]) < depth]


def _add_fronts(
    systems: Sequence[TrialSystem], problems: Sequence[RegressionRows], task: DiscoveryProblem
) -> Systems:
    """The systems with a front per equation, which holds each of their supports once."""
    rows = {state: problem for problem in problems for state in problem.equations}
    fronts, places = [], np.zeros((len(systems), len(task.states)), dtype=np.int64)
    for column, state in enumerate(task.states):
        terms = [
            [term for s, term in system.constraint.coefficients if s == state] for system in systems
        ]
        masks = np.stack([np.isin(task.library.names, own) for own in terms])
        different, owner = np.unique(masks, axis=0, return_inverse=True)
        order = np.argsort(different.sum(axis=1), kind="stable")
        nothing = np.zeros((1, masks.shape[1]), dtype=np.bool_)
        masks = np.concatenate([nothing, different[order]])
        fronts.append(ParetoFront(state, fit_supports(rows[state], state, masks), rows[state]))
        places[:, column] = 1 + np.argsort(order)[owner.ravel()]
    return Systems(fronts, places, systems)
