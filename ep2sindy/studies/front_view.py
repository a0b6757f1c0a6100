"""How a front reads: a row per candidate, the last fit, and what was published."""

from __future__ import annotations

from collections.abc import Mapping

import pandas as pd

from ep2sindy.library.equations import equation_text
from ep2sindy.library.units import Clock
from ep2sindy.report.document import Equation, Table, places
from ep2sindy.search.front import Candidate, ParetoFront
from ep2sindy.selection.rule import selected
from ep2sindy.studies.library_result import LibraryResult

# What the columns of a front mean, by the labels of selection rules where those need words.
COLUMNS = (
    "R2: of the derivative, on rows held out from the fit where there are any; share: of the "
    "bootstraps that proposed these terms."
)
RULES = {
    "d_pareto": "d_pareto: distance to the corner of no error and no terms",
    "deviance": "deviance: -2 log likelihood of the trajectories plus the prices of all terms, "
    "above the least",
}


def candidate_text(candidate: Candidate) -> str:
    """`n_i' = -2.62e+05 n_i + 5.48e-14 n_i n_n`."""
    return equation_text(candidate.equation, candidate.coef_by_term)


def front_table(result: LibraryResult, state: str) -> pd.DataFrame:
    """A front as in the thesis's Tables I-III: one row per candidate, with its equation in SI."""
    front, scores = result.discovery.fronts[state], result.discovery.scores[state]
    chosen = selected(front, scores)
    return pd.DataFrame(
        {
            "equation": front.equation,
            "n_terms": [c.n_terms for c in front.candidates],
            **_r2_columns(front),
            result.recipe.selection.label: scores,
            "share": [c.share for c in front.candidates],
            "selected": [c is chosen for c in front.candidates],
            "text": [candidate_text(c) for c in front.candidates],
        }
    )


def _r2_columns(front: ParetoFront) -> dict[str, list[float]]:
    """None of a search of trajectories, which has no rows."""
    if front.problem is None:
        return {}
    return {
        "r2_test": [c.r2_test for c in front.candidates],
        "r2_train": [c.r2_train for c in front.candidates],
    }


def readable_front(result: LibraryResult, state: str, clock: Clock) -> Table:
    """Candidates, the selected one bold; below them the last fit, and what was published."""
    label = result.recipe.selection.label
    front, scores = result.discovery.fronts[state], result.discovery.scores[state]
    chosen, held_out = selected(front, scores), front.held_out

    def equation(terms: Mapping[str, float], lead: str = "", mark: str = "") -> Equation:
        shown = {name: clock.seconds * coef for name, coef in terms.items()}
        return Equation(state, shown, lead=lead, mark=mark)

    rows: list[tuple[str, str, str, str, Equation]] = []
    for each, score in zip(front.candidates, scores, strict=True):
        r2 = each.r2_test if held_out else each.r2_train
        mark = "  <- selected" if each is chosen else ""
        rows.append(
            (
                str(each.n_terms), places(r2, 3), places(score, 3), places(each.share, 2),
                equation(each.coef_by_term, mark=mark),
            )
        )  # fmt: skip
    terms = result.discovery.model.terms(state)
    if terms != chosen.coef_by_term:
        rows.append(("", "", "", "", equation(terms, "weighted")))
    italic = []
    if state in result.refitted:
        here = result.refitted[state]
        italic = [len(rows), len(rows) + 1]
        rows.append(("", "", "", "", equation(result.given[state], "thesis")))
        score = places(here.r2_test if held_out else here.r2_train, 3)
        row = (str(here.n_terms), score, "", "", equation(here.coef_by_term, "its terms here"))
        rows.append(row)
    header = "R2 test" if held_out else "R2 train"
    table = pd.DataFrame(rows, columns=["terms", header, label, "share", "model"])
    for column in (header, "share"):  # of a search without rows, or without bootstraps
        if table[column].isin(["-", ""]).all():
            del table[column]
    unit = clock.rate_unit(result.discovery.model.units[state])
    bold = [k for k, each in enumerate(front.candidates) if each is chosen]
    return Table(table, title=f"candidates for {state}' [{unit}]", bold=bold, italic=italic)


def column_note(label: str) -> str:
    """What the columns of the fronts say."""
    rule = RULES.get(label, f"{label}: the score of the selection, least selected")
    # Candidates that are weighed by trajectories have neither rows nor bootstraps.
    return f"{rule}." if label == "deviance" else f"{rule}. {COLUMNS}"
