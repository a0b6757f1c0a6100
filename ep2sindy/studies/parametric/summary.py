"""`summary.json` of the parametric study, and the numbers its runs are compared by."""

from __future__ import annotations

from math import nan
from typing import Any

from ep2sindy.studies.parametric.all_points import JointResult
from ep2sindy.studies.parametric.points import REFINED, PointResult
from ep2sindy.studies.parametric.tables import Findings


def summary(found: Findings) -> dict[str, Any]:
    """What later work reads: points with their quantities, laws, trends, the joint search."""
    return {
        "points": [_point_summary(found, number) for number in range(len(found.results))],
        "laws": {
            fit: {
                name: {
                    "terms": law.coef_by_term,
                    "r2": law.r2,
                    "loo_error": law.loo_error,
                    "search_error": law.search_error,
                }
                for name, law in by_quantity.items()
            }
            for fit, by_quantity in found.laws.items()
        },
        "trends": found.trends.to_dict("records"),
        "joint": found.joint and _joint_summary(found.joint),
    }


def headline(found: Findings) -> dict[str, float]:
    """How many points oscillate, and how well laws predict; NaN for one that was not found."""
    scalars = {"n_oscillating": float(sum(bool(result.fits) for result in found.results))}
    for fit, case in found.study.fits.items():
        for name in case.quantities:
            law = found.laws.get(fit, {}).get(name)
            errors = (law.loo_error, law.search_error) if law else (nan, nan)
            for error, value in zip(("loo_error", "search_error"), errors, strict=True):
                scalars[f"law/{fit}/{name}/{error}"] = value
    return scalars


def live(result: PointResult) -> dict[str, float]:
    """What TensorBoard shows of a point as it comes."""
    scalars: dict[str, float] = {}
    for fit, fitted in result.fits.items():
        scalars |= {f"{fit}/{name}": each.value for name, each in fitted.estimates.items()}
        scalars |= {f"{fit}/r2/{state}": value for state, value in fitted.r2.items()}
    return scalars


def _joint_summary(joint: JointResult) -> dict[str, Any]:
    """The support for all points, and its coefficients as polynomials of the parameters."""
    tied = joint.tied and {
        state: {
            term: dict(zip(joint.tied.law.names, row.tolist(), strict=True))
            for term, row in zip(equation.terms, equation.coef, strict=True)
        }
        for state, equation in joint.tied.equations.items()
    }
    return {
        "terms": {state: list(terms) for state, terms in joint.found.chosen.items()},
        "tied": tied,
        "why_not_tied": joint.why_not_tied or None,
    }


def _point_summary(found: Findings, number: int) -> dict[str, Any]:
    """Quantities are null where a point has no fit, or a refinement nothing finite."""
    result = found.results[number]
    cases = found.study.cases
    return {
        **result.parameters,
        "status": result.status,
        "f_kHz": 1e-3 * result.f_Hz,
        "n_samples": result.n_samples,
        "dt_s": result.dt_s,
        **{name: _values(found, result, name) for name in cases},
        "ci95": {name: _intervals(result, name) for name in cases},
        "r2": {name: dict(result.fits[name].r2) for name in cases if name in result.fits},
        "refined": {name: _refined_summary(found, result, name + REFINED) for name in cases},
        "searched": {
            search: {state: fitted.model.terms(state) for state in fitted.model.states}
            for search, each in found.searches.items()
            if (fitted := each[number]) is not None
        },
    }


def _refined_summary(found: Findings, result: PointResult, name: str) -> dict[str, Any]:
    fit = result.fits.get(name)
    return {
        "status": fit and fit.status,
        "loss": fit and fit.loss,
        **_values(found, result, name),
        "ci95": _intervals(result, name),
        "r2": fit and dict(fit.r2),
    }


def _values(found: Findings, result: PointResult, name: str) -> dict[str, float | None]:
    known = result.fits[name].estimates if name in result.fits else {}
    return {q: known[q].value if q in known else None for q in found.study.fits[name].quantities}


def _intervals(result: PointResult, name: str) -> dict[str, list[float]] | None:
    if name not in result.fits:
        return None
    return {q: [e.low, e.high] for q, e in result.fits[name].estimates.items()}
