"""The last fit: chosen terms of every equation, weighted where noise is known, as one model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag

from ep2sindy.library.library import Library
from ep2sindy.model.model import SparseModel, coef_matrix
from ep2sindy.regression.rows import Regression
from ep2sindy.regression.whitening import whitened_rows
from ep2sindy.search.front import Candidate, ParetoFront


def last_fit(front: ParetoFront, candidate: Candidate) -> Candidate:
    """A selected candidate as it goes into the model: weighted, where the noise is known."""
    return candidate if front.problem.noisy is None else reweighted(front.problem, candidate)


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

    Returns it with new coefficients and their covariance, in SI; its scores stay.
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
    return replace(
        candidate,
        coef=np.linalg.lstsq(theta, rows.target, rcond=None)[0] * scale[order],
        covariance=root @ root.T,
    )
