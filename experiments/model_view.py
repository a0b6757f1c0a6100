"""How fitted models read, whatever fitted them: coefficients, intervals, frequency."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from ep2sindy.library.equations import equation_html
from ep2sindy.model.integrated import Integrated
from ep2sindy.model.model import SparseModel
from ep2sindy.signals.spectrum import frequency_text


def coefficients(models: Mapping[str, SparseModel], *, heading: str) -> pd.DataFrame:
    """One row per model, state and term: in SI, with 95 % intervals where they are known.

    heading: of the column that holds the models' names.
    """
    rows = []
    for name, model in models.items():
        for state in model.states:
            ends = model.intervals(state) if model.covariance is not None else {}
            for term, value in model.terms(state).items():
                lower, upper = ends.get(term, (np.nan, np.nan))
                row: dict[str, Any] = {heading: name, "state": state, "term": term}
                rows.append(row | {"coef": value, "lower": lower, "upper": upper})
    return pd.DataFrame(rows)


def intervals_text(model: SparseModel, state: str) -> str:
    """`n_i: -6.77e+05 to -6.74e+05`, term by term."""
    ends = model.intervals(state)
    return "; ".join(f"{term}: {low:.4g} to {high:.4g}" for term, (low, high) in ends.items())


def frequency_cell(integrated: Integrated, state: str, f_error: float) -> str:
    """`14.1 kHz (+0 %)`, or what became of the model instead."""
    frequency_Hz = integrated.frequency_Hz[state]
    if np.isnan(frequency_Hz):
        return integrated.verdict
    return f"{frequency_text(frequency_Hz)} ({100 * f_error:+.0f} %)"


def equations_html(models: Mapping[str, SparseModel]) -> list[str]:
    """Under the name of each model its equations, with intervals where they are known."""
    body = []
    for name, model in models.items():
        body.append(f"<h3>{name}</h3>")
        for state in model.states:
            body.append(f'<p class="equation">{equation_html(state, model.terms(state))}</p>')
            if model.covariance is not None:
                body.append(f'<p class="published">95 %: {intervals_text(model, state)}</p>')
    return body
