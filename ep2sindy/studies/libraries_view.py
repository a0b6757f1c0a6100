"""How the outcome of `libraries` reads: fronts, equations, trajectories."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.figures.fronts import front_figure
from ep2sindy.library.equations import equation_text
from ep2sindy.model.free_run import FreeRun
from ep2sindy.model.model import SparseModel
from ep2sindy.report.document import (
    Block,
    Captioned,
    Equation,
    Picture,
    Section,
    Table,
    Text,
    pictures,
    places,
)
from ep2sindy.search.front import Candidate
from ep2sindy.selection.rule import selected
from ep2sindy.signals.spectrum import dominant_frequency, frequency_text
from ep2sindy.studies.library_result import LibraryResult
from ep2sindy.studies.living import Living
from ep2sindy.studies.living_view import (
    living_figures,
    living_models,
    living_section,
    living_summary,
    living_tables,
)
from ep2sindy.studies.records_view import records_sections, records_tables
from ep2sindy.studies.shown import INTEGRATED, Shown, rollout_tables, run_figures, trajectories
from ep2sindy.studies.source import data_summary
from ep2sindy.studies.term_roles import roles_section, roles_summary, roles_table

FIGURES = ("data", "trajectories", "trajectories_thesis", "derivatives", "phase")
THESIS = "The same with the thesis's terms, fitted to these data."
FRONT = (
    "Error against number of terms: every support that the search proposed, and the best of each "
    "size; the star is selected. Carets at the upper edge: models far worse than none."
)


@dataclass(frozen=True, eq=False)
class Outcome:
    """What every library found in the same data; files: of all records, data being the first."""

    data: Trajectory
    results: Mapping[str, LibraryResult]
    shown: Shown
    files: Sequence[str] = ()

    @property
    def published(self) -> dict[str, FreeRun]:
        """Models of published terms, where they could be fitted to our data."""
        return {n: r.published for n, r in self.results.items() if r.published is not None}

    @property
    def selected(self) -> dict[str, FreeRun]:
        return {name: result.selected for name, result in self.results.items()}

    @property
    def living(self) -> dict[str, Living]:
        """Models that were searched for on their own cycle, by library."""
        return {n: r.living for n, r in self.results.items() if r.living is not None}

    def models(self) -> dict[str, SparseModel]:
        found = {name: result.discovery.model for name, result in self.results.items()}
        return found | living_models(self.living)

    def tables(self) -> dict[str, pd.DataFrame]:
        found = {}
        for name, result in self.results.items():
            fronts = [_front_table(result, state) for state in result.discovery.fronts]
            found[f"front_{name}"] = pd.concat(fronts)
            found[f"ambiguities_{name}"] = pd.DataFrame(
                [(a.exact, " ".join(a.terms), a.message) for a in result.discovery.ambiguities],
                columns=["exact", "terms", "message"],
            )
        published = {f"{name}_thesis_terms": each for name, each in self.published.items()}
        found |= rollout_tables(self.data, self.selected | published)
        for name, result in self.results.items():
            if result.roles is not None:
                found[f"roles_{name}"] = roles_table(result.roles)
        found |= living_tables(self.living) | {"comparison": self.comparison()}
        return found | records_tables(self.results, self.files)

    def comparison(self) -> pd.DataFrame:
        """One row per model: frequencies in Hz, trajectory error, and a word on the trajectory."""
        published = {f"{name}, thesis's terms": each for name, each in self.published.items()}
        rows = []
        for name, model in (self.selected | published).items():
            row: dict[str, Any] = {"model": name}
            for state, column in zip(self.data.state_names, self.data.states.T, strict=True):
                row[f"f_data_{state}_Hz"] = dominant_frequency(self.data.t, column)
                row[f"f_model_{state}_Hz"] = model.frequency_Hz[state]
            rows.append(row | {"nrmse": model.nrmse, "verdict": model.text})
        return pd.DataFrame(rows)

    def figures(self) -> dict[str, Captioned]:
        formulation = next(iter(self.results.values())).recipe.formulation
        drawn = run_figures(FIGURES, self.data, self.selected, self.shown, formulation=formulation)
        if self.published:
            drawn["trajectories_thesis"] = trajectories(
                self.data, self.published, self.shown, THESIS
            )
        for name, result in self.results.items():
            found, label = result.discovery, result.recipe.selection.label
            front = partial(front_figure, found.fronts, found.scores, label=label)
            drawn[f"front_{name}"] = Captioned(front, FRONT)
        for name, living in self.living.items():
            drawn |= living_figures(name, living)
        return drawn

    def sections(self) -> list[Section]:
        found = [_library_section(name, result) for name, result in self.results.items()]
        lives = []
        for name, living in self.living.items():
            lives.append(living_section(name, living, living_figures(name, living)))
            if (roles := self.results[name].roles) is not None:
                lives.append(roles_section(name, roles))
        shown = Section("Integrated", [self._comparison_table(), *pictures(FIGURES)])
        return [*found, *lives, shown, *records_sections(self.results, self.files)]

    def _comparison_table(self) -> Table:
        rows = []
        for row in self.comparison().to_dict("records"):
            for k, state in enumerate(self.data.state_names):
                rows.append(
                    {
                        "model": "" if k else row["model"],
                        "state": state,
                        "f data": frequency_text(row[f"f_data_{state}_Hz"]),
                        "f model": frequency_text(row[f"f_model_{state}_Hz"]),
                        "nrmse": "" if k else places(row["nrmse"], 3),
                        "verdict": "" if k else row["verdict"],
                    }
                )
        return Table(pd.DataFrame(rows), title=INTEGRATED)

    def summary(self) -> dict[str, Any]:
        first = self.data.state_names[0]
        models = {
            name: {
                "equations": {s: _equation_summary(result, s) for s in result.discovery.fronts},
                "trajectory": _trajectory_summary(result.selected, first),
                "thesis_terms": _published_summary(result, first),
                "living": living_summary(result.living),
                "roles": roles_summary(result.roles),
            }
            for name, result in self.results.items()
        }
        return {"data": data_summary(self.data), "models": models}

    def headline(self) -> dict[str, float]:
        scalars = {}
        for name, result in self.results.items():
            first = self.data.state_names[0]
            scalars[f"{name}/f_kHz"] = 1e-3 * result.selected.frequency_Hz[first]
            scalars[f"{name}/nrmse"] = result.selected.nrmse
            for state, chosen in result.discovery.chosen.items():
                scalars[f"{name}/{state}/r2_test"] = chosen.r2_test
                scalars[f"{name}/{state}/n_terms"] = float(chosen.n_terms)
                score = float(result.discovery.scores[state].min())
                scalars[f"{name}/{state}/{result.recipe.selection.label}"] = score
        for name, living in self.living.items():
            scalars[f"{name}/living/f_error"] = living.run.f_error
            scalars[f"{name}/living/waveform_error"] = max(living.run.waveform_error.values())
        return scalars


def candidate_text(candidate: Candidate) -> str:
    """`n_i' = -2.62e+05 n_i + 5.48e-14 n_i n_n`."""
    return equation_text(candidate.equation, candidate.coef_by_term)


def _front_table(result: LibraryResult, state: str) -> pd.DataFrame:
    """A front as in the thesis's Tables I-III: one row per candidate, with its equation."""
    front, scores = result.discovery.fronts[state], result.discovery.scores[state]
    chosen = selected(front, scores)
    return pd.DataFrame(
        {
            "equation": front.equation,
            "n_terms": [c.n_terms for c in front.candidates],
            "r2_test": [c.r2_test for c in front.candidates],
            "r2_train": [c.r2_train for c in front.candidates],
            result.recipe.selection.label: scores,
            "share": [c.share for c in front.candidates],
            "selected": [c is chosen for c in front.candidates],
            "text": [candidate_text(c) for c in front.candidates],
        }
    )


def _library_section(name: str, result: LibraryResult) -> Section:
    library, found = result.discovery.model.library, result.discovery
    blocks: list[Block] = [
        Text(
            f"{len(library)} terms in {', '.join(library.variables)}; "
            f"selection: {result.recipe.selection}"
        ),
        *(Text(f"note: {each.message}") for each in found.ambiguities if each.exact),
    ]
    n_alike = sum(not each.exact for each in found.ambiguities)
    if n_alike:
        blocks.append(
            Text(f"note: nearly proportional terms: {n_alike}, see tables/ambiguities_{name}.csv")
        )
    for state in found.fronts:
        blocks.append(Equation(state, found.model.terms(state)))
        if state in result.refitted:
            blocks.append(Equation(state, result.given[state], lead="thesis", aside=True))
        blocks.append(_readable_front(result, state))
    return Section(name, [*blocks, Picture(f"front_{name}")])


def _readable_front(result: LibraryResult, state: str) -> Table:
    """Candidates, the selected one bold; below them the last fit, and what was published."""
    label = result.recipe.selection.label
    front, scores = result.discovery.fronts[state], result.discovery.scores[state]
    held_out = front.problem.test.any()
    r2, header = ("r2_test", "R2 test") if held_out else ("r2_train", "R2 train")
    columns = ["terms", header, label, "share", "model"]
    table = _front_table(result, state)
    rows = []
    for row in table.to_dict("records"):
        numbers = places(row[r2], 3), places(row[label], 3), places(row["share"], 2)
        mark = "  <- selected" if row["selected"] else ""
        rows.append((str(row["n_terms"]), *numbers, row["text"] + mark))
    terms = result.discovery.model.terms(state)
    if terms != selected(front, scores).coef_by_term:
        rows.append(("", "", "", "", f"weighted: {equation_text(state, terms)}"))
    italic = []
    if state in result.refitted:
        here = result.refitted[state]
        score = here.r2_test if held_out else here.r2_train
        italic = [len(rows), len(rows) + 1]
        rows.append(("", "", "", "", f"thesis: {equation_text(state, result.given[state])}"))
        text = f"its terms here: {candidate_text(here)}"
        rows.append((str(here.n_terms), places(score, 3), "", "", text))
    bold = np.flatnonzero(table["selected"]).tolist()
    return Table(pd.DataFrame(rows, columns=columns), bold=bold, italic=italic)


def _trajectory_summary(integrated: FreeRun, state: str) -> dict[str, Any]:
    return {
        "f_kHz": 1e-3 * integrated.frequency_Hz[state],
        "nrmse": integrated.nrmse,
        "diverged": integrated.rollout.diverged,
    }


def _published_summary(result: LibraryResult, state: str) -> dict[str, Any] | None:
    """The published terms fitted to our data."""
    if result.published is None:
        return None
    return {
        "equations": {
            name: {
                "terms": result.published.model.terms(name),
                "r2_test": candidate.r2_test,
                "text": candidate_text(candidate),
            }
            for name, candidate in result.refitted.items()
        },
        "trajectory": _trajectory_summary(result.published, state),
    }


def _equation_summary(result: LibraryResult, state: str) -> dict[str, Any]:
    chosen, scores = result.discovery.chosen[state], result.discovery.scores[state]
    terms = result.discovery.model.terms(state)
    return {
        "terms": terms,
        "n_terms": chosen.n_terms,
        "r2_test": chosen.r2_test,
        "r2_train": chosen.r2_train,
        result.recipe.selection.label: float(scores.min()),
        "share": chosen.share,
        "inclusion": dict(zip(chosen.terms, chosen.inclusion.tolist(), strict=True)),
        "text": equation_text(state, terms),
    }
