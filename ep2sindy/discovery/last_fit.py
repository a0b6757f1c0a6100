"""The last fit: chosen terms of every equation, weighted where noise is known, as one model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import Library
from ep2sindy.model.model import SparseModel, coef_matrix
from ep2sindy.regression.rows import Regression
from ep2sindy.regression.splits import RandomSplit
from ep2sindy.regression.weak import Weak
from ep2sindy.regression.whitening import whitened_rows
from ep2sindy.search.front import Candidate, ParetoFront

# Of a right equation chi-squared per row is 1, give or take a standard error, and a little more:
# the noise is estimated from the samples that it judges. Measured: 0.7 to 1.3 with 70 rows.
MOST_CHI_SQUARED, STANDARD_ERRORS = 1.2, 3.0

SMALLEST = np.finfo(np.float64).tiny  # an exact fit leaves nothing


def last_fit(front: ParetoFront, candidate: Candidate) -> Candidate:
    """A selected candidate as it goes into the model: weighted, where the noise is known."""
    return candidate if front.problem.noisy is None else reweighted(front.problem, candidate)


def judged(
    chosen: Sequence[Candidate], runs: Sequence[Trajectory], library: Library
) -> list[Candidate]:
    """Candidates with what their terms leave of the noise, also where their rows do not know it.

    Then weak rows of the same runs are asked; coefficients stay as they are. Where there are none,
    as of a record of a few samples, nothing is said.
    """
    unknown = [c for c in chosen if c.chi_squared is None]
    if not unknown or not runs:
        return list(chosen)
    try:
        # The same numbers as with all terms, at a fraction of their cost.
        used = np.isin(library.names, [name for c in unknown for name in c.terms])
        used[0] |= not used.any()  # a library needs a term
        form, rng = Weak(split=RandomSplit(0.0)), np.random.default_rng(0)
        rows = form.assemble(runs, library.take(used), rng=rng)
        found = {problem.equations[0]: problem for problem in rows}
        fitted = {c.equation: reweighted(found[c.equation], c) for c in unknown}
    except (ValueError, np.linalg.LinAlgError):
        return list(chosen)
    return [_as_judged(c, fitted.get(c.equation, c)) for c in chosen]


def _as_judged(candidate: Candidate, fitted: Candidate) -> Candidate:
    return replace(
        candidate,
        covariance=candidate.covariance if fitted.leaves_noise else None,
        chi_squared=fitted.chi_squared,
        autocorrelation=fitted.autocorrelation,
        leaves_noise=fitted.leaves_noise,
    )


def misfit_of(chosen: Sequence[Candidate]) -> str:
    """Which equations leave more than noise, in a sentence; empty where none does."""
    left = {c.equation: c.chi_squared for c in chosen if c.leaves_noise is False}
    if not left:
        return ""
    parts = ", ".join(f"{state}' ({value:.3g} times its size)" for state, value in left.items())
    return (
        f"no equation of this library leaves white noise of {parts}: intervals are not given; "
        "add terms or states, or judge the model by free run"
    )


def assemble_model(
    library: Library,
    candidates: Sequence[Candidate],
    *,
    units: Mapping[str, str],
    provenance: Mapping[str, str],
) -> SparseModel:
    """Join one candidate per equation into a model, as if errors of equations were independent."""
    blocks = [c.covariance for c in candidates if c.covariance is not None]
    return SparseModel(
        library=library,
        states=[c.equation for c in candidates],
        coef=coef_matrix(library, [c.coef_by_term for c in candidates]),
        units=units,
        provenance=provenance,
        covariance=block_diag(*blocks) if len(blocks) == len(candidates) else None,
    )


def reweighted(problem: Regression, candidate: Candidate, *, n_steps: int = 8) -> Candidate:
    """Fit a candidate's terms again, with weights and corrected samples, and say how well.

    Returns it with new coefficients, their covariance, in SI, and chi-squared; its scores stay.
    What leaves more than the noise of its rows has no covariance: it would not hold the truth.
    """
    terms = np.isin(problem.term_names, candidate.terms)
    scale = problem.coef_scale(0)
    coef = np.zeros(len(terms))
    order = [problem.library.index(name) for name in candidate.terms]
    coef[order] = candidate.coef / scale[order]
    rows = whitened_rows(problem, terms, coef, n_steps=n_steps)
    theta = rows.theta[:, order]
    upper = np.linalg.qr(theta, mode="r")
    root = np.linalg.inv(upper) * scale[order, None]
    fitted = np.linalg.lstsq(theta, rows.target, rcond=None)[0]
    left = rows.target - theta @ fitted
    freedom = max(len(left) - len(order), 1)
    chi_squared = float(left @ left) / freedom
    leaves_noise = chi_squared <= MOST_CHI_SQUARED + STANDARD_ERRORS * np.sqrt(2.0 / freedom)
    return replace(
        candidate,
        coef=fitted * scale[order],
        covariance=root @ root.T if leaves_noise else None,
        chi_squared=chi_squared,
        autocorrelation=float(left[1:] @ left[:-1]) / max(float(left @ left), SMALLEST),
        leaves_noise=bool(leaves_noise),
    )
