"""Models on pages, in tables and in summaries: their equations and coefficients with intervals."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from ep2sindy.library.relations import Constraint
from ep2sindy.library.units import SECONDS, Clock, unit_product
from ep2sindy.model.display import grouped
from ep2sindy.model.model import SparseModel
from ep2sindy.report.document import Equation, Table

NO_ENDS = (np.nan, np.nan)  # of an interval that is not known


def intervals(model: SparseModel) -> dict[str, dict[str, tuple[float, float]]] | None:
    """95 % intervals by state and term; None if they are not known."""
    if model.covariance is None:
        return None
    return {state: model.intervals(state) for state in model.states}


def model_facts(model: SparseModel, held: Constraint | None = None) -> dict[str, Any]:
    """A model in summary.json: its text and coefficients in SI, and their intervals if known.

    held: see `grouped`.
    """
    sums = grouped(model, held)
    lines = [Equation(state, terms).text for state, terms in sums.items()]
    equations = {state: model.terms(state) for state in model.states}
    return {"text": "\n".join(lines), "equations": equations, "intervals": intervals(model)}


def coefficients(models: Mapping[str, SparseModel]) -> pd.DataFrame:
    """One row per model, state and term, in SI, with 95 % intervals if they are known."""
    rows = [
        (name, state, term, value, *(intervals(model) or {}).get(state, {}).get(term, NO_ENDS))
        for name, model in models.items()
        for state in model.states
        for term, value in model.terms(state).items()
    ]
    return pd.DataFrame(rows, columns=["model", "state", "term", "coef", "lower", "upper"])


def equations(
    model: SparseModel,
    clock: Clock = SECONDS,
    *,
    held: Constraint | None = None,
    lead: str = "",
    on_screen: bool = True,
) -> list[Equation]:
    """The equations of a model with their units, per time unit of the clock.

    held: what the coefficients obey, to be grouped by process (`grouped`). lead: text before each.
    """
    units = {state: clock.rate_unit(model.units[state]) for state in model.states}
    return [
        Equation(state, terms, lead=lead, unit=units[state], on_screen=on_screen)
        for state, terms in grouped(model, held, clock).items()
    ]


def interval_table(
    model: SparseModel,
    clock: Clock = SECONDS,
    words: str = "95 %",
    note: str = "",
    *,
    page_only: bool = False,
) -> list[Table]:
    """Coefficients with 95 % intervals; no table if these are not known.

    words: what the intervals are called. note: what they mean.
    """
    if model.covariance is None:
        return []
    units = {term.name: term.unit(model.units) for term in model.library.terms}
    rows = []
    for state in model.states:
        for term, ends in model.intervals(state).items():
            numbers = [model.terms(state)[term], *ends]
            unit = unit_product([(model.units[state], 1), (units[term], -1)])
            shown = [f"{clock.seconds * number:.4g}" for number in numbers]
            shown = shown if ends[0] < ends[1] else [shown[0], "known", ""]
            rows.append([f"{state}'", term.replace("*", " "), *shown, clock.rate_unit(unit)])
    columns = ["equation", "term", "coefficient", f"{words} from", "to", "unit"]
    table = pd.DataFrame(rows, columns=columns)
    return [Table(table, note=note, page_only=page_only)] if rows else []


def with_error(value: float, reach: float) -> str:
    """`0.03640 ±2e-05`: the value to the digit of its error, with at least three digits.

    An error that is not known (NaN) is left out.
    """
    digits = 3
    if np.isfinite(reach) and reach > 0.0 and value != 0.0:
        # Digits of the error as it is printed: 9.6e-05 reads 1e-04.
        places = np.floor(np.log10([abs(value), float(f"{reach:.1g}")]))
        digits = int(np.clip(places[0] - places[1] + 1, 3, 8))
    text = f"{value:#.{digits}g}".removesuffix(".")
    return text if np.isnan(reach) else f"{text} ±{reach:.1g}"
