"""`summary.json` of `+exp=parametric`."""

from typing import Any

from omegaconf import DictConfig

from ep2sindy.studies.parametric.points import REFINED, PointResult
from experiments.parametric_tables import Outcome, trends_table


def summary(config: DictConfig, outcome: Outcome) -> dict[str, Any]:
    """What later work reads: points with their quantities, laws, trends, the joint search."""
    return {
        "experiment": config.experiment,
        "seed": config.seed,
        "points": [_point_summary(outcome, k) for k in range(len(outcome.results))],
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
            for fit, by_quantity in outcome.laws.items()
        },
        "trends": trends_table(outcome).to_dict("records"),
        "joint": _joint_summary(outcome),
    }


def _joint_summary(outcome: Outcome) -> dict[str, Any] | None:
    """The support for all points, and its coefficients as polynomials of the parameters."""
    joint = outcome.joint
    if joint is None:
        return None
    tied = joint.tied
    return {
        "terms": {state: list(terms) for state, terms in joint.found.chosen.items()},
        "tied": {
            state: {
                term: dict(zip(tied.law.names, row.tolist(), strict=True))
                for term, row in zip(equation.terms, equation.coef, strict=True)
            }
            for state, equation in tied.equations.items()
        }
        if tied
        else None,
        "why_not_tied": joint.why_not_tied or None,
    }


def _point_summary(outcome: Outcome, number: int) -> dict[str, Any]:
    """Quantities are null where a point has no fit, or a refinement nothing finite."""
    result = outcome.results[number]
    cases = outcome.study.cases
    refined = {}
    for name in cases:
        fit = result.fits.get(name + REFINED)
        refined[name] = {
            "status": fit.status if fit else None,
            "loss": fit.loss if fit else None,
            **_values(outcome, result, name, suffix=REFINED),
            "ci95": _intervals(result, name + REFINED),
            "r2": dict(fit.r2) if fit else None,
        }
    return {
        **result.parameters,
        "status": result.status,
        "f_kHz": 1e-3 * result.f_Hz,
        "n_samples": result.n_samples,
        "dt_s": result.dt_s,
        **{name: _values(outcome, result, name) for name in cases},
        "ci95": {name: _intervals(result, name) for name in cases},
        "r2": {name: dict(result.fits[name].r2) for name in cases if name in result.fits},
        "refined": refined,
        "searched": {
            search: {state: fitted.model.terms(state) for state in fitted.model.states}
            for search, found in outcome.searches.items()
            if (fitted := found[number]) is not None
        },
    }


def _values(
    outcome: Outcome, result: PointResult, case: str, *, suffix: str = ""
) -> dict[str, float | None]:
    fit = result.fits.get(case + suffix)
    known = fit.estimates if fit else {}
    names = outcome.study.cases[case].quantities
    return {name: known[name].value if name in known else None for name in names}


def _intervals(result: PointResult, name: str) -> dict[str, list[float]] | None:
    if name not in result.fits:
        return None
    return {q: [e.low, e.high] for q, e in result.fits[name].estimates.items()}
