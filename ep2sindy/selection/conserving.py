"""Search for systems of equations under roles: processes enter all of their equations or none."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from ep2sindy.data.coerce import DiscoveryProblem
from ep2sindy.data.numbers import column_norms
from ep2sindy.library.relations import Place, Process
from ep2sindy.library.roles import Roles, constraint_of, process_matrix
from ep2sindy.regression.constrained import MIN_RESIDUAL
from ep2sindy.regression.front import ParetoFront, fit_supports
from ep2sindy.regression.gram_kernels import fit_masks
from ep2sindy.regression.least_squares import LeastSquares
from ep2sindy.regression.rows import RegressionRows
from ep2sindy.regression.searches import Search
from ep2sindy.selection.systems import Systems, TrialSystem, find_broken_demands

Support = tuple[np.ndarray, np.ndarray]  # indices of processes, and their coefficients


def search_conserving_systems(
    problems: Sequence[RegressionRows],
    task: DiscoveryProblem,
    roles: Roles,
    search: Search,
    *,
    depth: int,
) -> Systems:
    """The systems that a search proposes for all equations at once, smallest first.

        minimise sum over equations e of |y_e - X_e (A_e z + d_e)|^2 / s_e^2 over supports of z

    z holds one amount per process, and column p of A_e its factor in every term of equation e,
    d_e what is known. So a search proposes processes, and what they move is conserved exactly. s_e
    is the standard deviation of what the whole library leaves of y_e; assumes residuals that are
    independent between rows and equations. Of every size, the `depth` best systems are kept in
    which every role is played by a process, and those that must be positive are: least squares with
    these bounds would put another to zero, which is a smaller system. problems: rows of the task's
    library with the terms of known equations, `with_known_terms`. Raises ValueError for roles that
    do not fit the task, or if no system plays them all. Called by `ep.discover(run,
    library.with_roles(roles), method)` for a method such as
    ep.Regression(selection=ep.FreeRunScore()); docs/roles.md shows what comes of it.
    """
    processes = roles.processes(task.library, task.states)
    task = replace(task, library=task.library.with_known_terms(task.states))
    columns, target = _join_rows(problems, task, processes, roles.known)
    norms = column_norms(columns)
    unit = columns / norms
    xx, xy = unit.T @ unit, unit.T @ target
    masks = search.supports(xx, xy, float(target @ target))
    complete = _keep_complete(masks, processes, roles.names)
    coef = fit_masks(xx, xy, complete)
    # The smallest come first, of a size by their residual.
    order = np.lexsort([*~complete.T[::-1], -coef @ xy, complete.sum(axis=1)])
    independent = order[np.isfinite(coef[order]).all(axis=1)]
    whole = [(np.flatnonzero(complete[k]), coef[k, complete[k]]) for k in independent]
    terms = [task.library.index(process.term) for process in processes]
    means = task.theta.mean(axis=0)[terms] if roles.forward else None

    def parts_of(support: Support) -> tuple[list[Process], np.ndarray, np.ndarray | None]:
        """Processes of a support, their coefficients, and the means of their terms."""
        chosen, values = support
        own_means = None if means is None else means[chosen]
        return [processes[k] for k in chosen], values / norms[chosen], own_means

    admissible = [support for support in whole if not find_broken_demands(*parts_of(support))]
    kept = _keep_first(admissible or whole, depth)
    found = []
    for chosen, values, own_means in map(parts_of, kept):
        held = constraint_of(task.library, task.states, chosen, roles.known_processes)
        if held is not None:  # its coefficients tell the processes apart
            fixed = np.array([roles.known.get(held.coefficients[k], 0.0) for k in held.free])
            free = process_matrix(held) @ values + fixed
            found.append(TrialSystem.of(task, held, free, own_means))
    if not found:
        raise ValueError(
            f"no system of up to {masks.sum(axis=1).max(initial=0)} terms plays all of the roles "
            f"{list(dict.fromkeys(process.role for process in processes))}: raise the search's "
            "max_terms or n_best, or give fewer roles"
        )
    return _add_fronts(found, problems, task)


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


def _keep_first(supports: Sequence[Support], depth: int) -> list[Support]:
    sizes = [len(chosen) for chosen, _ in supports]
    return [each for k, each in enumerate(supports) if k - sizes.index(sizes[k]) < depth]


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
