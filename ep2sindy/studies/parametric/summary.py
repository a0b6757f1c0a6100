"""`summary.json` of the parametric study, and the numbers its runs are compared by."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ep2sindy.operating.point_fits import Case, JointResult
from ep2sindy.operating.quantities import REFINED, Fitted, PointResult
from ep2sindy.operating.quantity_law import ControlLaw

Laws = Mapping[str, Mapping[str, ControlLaw]]  # fit -> quantity -> law


def point_summary(
    result: PointResult, cases: Mapping[str, Case], searched: Mapping[str, Fitted | None]
) -> dict[str, Any]:
    """Quantities are null where a point has no fit, or a refinement nothing finite."""
    found = {name: _fit_summary(result.fits.get(name), case) for name, case in cases.items()}
    refined: dict[str, dict[str, Any]] = {}
    for name, case in cases.items():
        fit = result.fits.get(name + REFINED)
        values, ends, r2 = _fit_summary(fit, case)
        refined[name] = {"status": fit and fit.status, "loss": fit and fit.loss, **values}
        refined[name] |= {"ci95": ends, "r2": r2}
    return {
        **result.parameters,
        "status": result.status,
        "f_kHz": 1e-3 * result.f_Hz,
        "n_samples": result.n_samples,
        "dt_s": result.dt_s,
        **{name: values for name, (values, _, _) in found.items()},
        "ci95": {name: ends for name, (_, ends, _) in found.items()},
        "r2": {name: r2 for name, (_, _, r2) in found.items() if r2},
        "refined": refined,
        "searched": {
            search: {state: each.model.terms(state) for state in each.model.states}
            for search, each in searched.items()
            if each is not None
        },
    }


def _fit_summary(
    fit: Fitted | None, case: Case
) -> tuple[dict[str, float | None], dict[str, list[float]] | None, dict[str, float] | None]:
    """Values by quantity; ends of their intervals; R2 by state."""
    if fit is None:
        return dict.fromkeys(case.quantities), None, None
    known = fit.estimates
    values = {name: known[name].value if name in known else None for name in case.quantities}
    return values, {name: [each.low, each.high] for name, each in known.items()}, dict(fit.r2)


def laws_summary(laws: Laws) -> dict[str, Any]:
    return {
        fit: {
            name: {
                "terms": law.coef_by_term,
                "r2": law.r2,
                "loo_error": law.loo_error,
                "search_error": law.search_error,
            }
            for name, law in by_quantity.items()
        }
        for fit, by_quantity in laws.items()
    }


def joint_summary(joint: JointResult | None) -> dict[str, Any] | None:
    """The support for all points, and its coefficients as polynomials of the parameters."""
    if joint is None:
        return None
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


def law_errors(laws: Laws, fits: Mapping[str, Case]) -> dict[str, float]:
    """How well laws predict, by fit and quantity; NaN for one that was not found."""
    errors = {}
    for fit, case in fits.items():
        for name in case.quantities:
            law = laws.get(fit, {}).get(name)
            errors[f"law/{fit}/{name}/loo_error"] = law.loo_error if law else float("nan")
            errors[f"law/{fit}/{name}/search_error"] = law.search_error if law else float("nan")
    return errors


def live(result: PointResult) -> dict[str, float]:
    """What TensorBoard shows of a point as it comes."""
    scalars: dict[str, float] = {}
    for fit, fitted in result.fits.items():
        scalars |= {f"{fit}/{name}": each.value for name, each in fitted.estimates.items()}
        scalars |= {f"{fit}/r2/{state}": value for state, value in fitted.r2.items()}
    return scalars
