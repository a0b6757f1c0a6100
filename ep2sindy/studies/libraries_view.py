"""How the outcome of `libraries` reads: fronts, equations, trajectories."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import pandas as pd

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.choice import NoiseTest
from ep2sindy.figures.fronts import front_figure
from ep2sindy.library.equations import equation_text
from ep2sindy.library.units import Clock
from ep2sindy.model.free_run import FreeRun
from ep2sindy.model.model import SparseModel
from ep2sindy.report.document import (
    Block,
    Captioned,
    Picture,
    Section,
    Table,
    Text,
    pictures,
    places,
)
from ep2sindy.signals.smoothers import Smoother
from ep2sindy.signals.spectrum import dominant_frequency
from ep2sindy.studies.estimate_view import estimate_section, estimate_summary
from ep2sindy.studies.front_view import candidate_text, column_note, front_table, readable_front
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
from ep2sindy.studies.shown import (
    INTEGRATED,
    Shown,
    interval_table,
    rollout_tables,
    run_figures,
    shown_equation,
    trajectories,
)
from ep2sindy.studies.source import data_summary
from ep2sindy.studies.term_roles import roles_section, roles_summary, roles_table

FIGURES = ("data", "trajectories", "trajectories_thesis", "derivatives", "phase")
THESIS = "The same with the thesis's terms, fitted to these data."
FRONT = (
    "Error against number of terms: every support that the search proposed, and the best of each "
    "size; the star is selected. Carets at the upper edge: models far worse than none."
)
SCORED = (
    "Score against number of terms, the best of each size; the star is selected. States and "
    "coefficients were estimated together: there are no rows to have an error."
)


@dataclass(frozen=True, eq=False)
class Outcome:
    """What every library found in the same data; files: of all records, data being the first.

    smoother: of the data's derivative.
    """

    data: Trajectory
    results: Mapping[str, LibraryResult]
    shown: Shown
    smoother: Smoother | None
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
            fronts = [front_table(result, state) for state in result.discovery.fronts]
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
        drawn = run_figures(FIGURES, self.data, self.selected, self.shown, smoother=self.smoother)
        if self.published:
            drawn["trajectories_thesis"] = trajectories(
                self.data, self.published, self.shown, THESIS
            )
        for name, result in self.results.items():
            found, label = result.discovery, result.recipe.selection.label
            front = partial(front_figure, found.fronts, found.scores, label=label)
            has_rows = any(each.problem is not None for each in found.fronts.values())
            drawn[f"front_{name}"] = Captioned(front, FRONT if has_rows else SCORED)
        for name, living in self.living.items():
            drawn |= living_figures(name, living)
        return drawn

    def sections(self) -> list[Section]:
        found = [self._in_short()]
        for name, result in self.results.items():
            found.append(_library_section(name, result, self.data.clock))
            if (estimate := result.discovery.estimate) is not None:
                found.append(estimate_section(name, estimate, self.data))
        lives = []
        for name, living in self.living.items():
            lives.append(living_section(name, living, living_figures(name, living)))
            if (roles := self.results[name].roles) is not None:
                lives.append(roles_section(name, roles))
        shown = Section(
            "Run freely from the first sample", [self._comparison_table(), *pictures(FIGURES)]
        )
        return [*found, *lives, shown, *records_sections(self.results, self.files)]

    def _in_short(self) -> Section:
        """The equations that were found and how they run; a screen ends with them anyway."""
        blocks: list[Block] = []
        for name, result in self.results.items():
            living, clock = result.living, self.data.clock
            run = result.selected if living is None else living.run
            how = "selected by their derivatives" if living is None else "selected by free runs"
            if result.discovery.estimate is not None and living is None:
                how = "estimated together with the states"
            text = f"{name}: equations {how}; run freely: {run.text}"
            blocks.append(Text(text, page_only=True))
            for state in run.model.states:
                blocks.append(shown_equation(run.model, state, clock, on_screen=False))
            if living is None:
                blocks += interval_table(run.model, clock=clock, page_only=True)
        return Section("What was found", blocks)

    def _comparison_table(self) -> Table:
        rows, text = [], self.data.clock.frequency_text
        for row in self.comparison().to_dict("records"):
            for k, state in enumerate(self.data.state_names):
                rows.append(
                    {
                        "model": "" if k else row["model"],
                        "state": state,
                        "frequency of the data": self.data.clock.frequency_text(
                            row[f"f_data_{state}_Hz"]
                        ),
                        "of the model": text(row[f"f_model_{state}_Hz"]),
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
            | _estimate(result)
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


def _estimate(result: LibraryResult) -> dict[str, Any]:
    found = result.discovery.estimate
    return {} if found is None else {"estimate": estimate_summary(found)}


def _library_section(name: str, result: LibraryResult, clock: Clock) -> Section:
    library, found = result.discovery.model.library, result.discovery
    blocks: list[Block] = [
        Text(
            f"{len(library)} terms in {', '.join(library.variables)}; "
            f"selection: {result.recipe.selection}"
        ),
        *(Text(f"note: {each}") for each in found.remarks),
        *(Text(f"note: {each.message}") for each in found.ambiguities if each.exact),
    ]
    n_alike = sum(not each.exact for each in found.ambiguities)
    if n_alike:
        blocks.append(
            Text(f"note: nearly proportional terms: {n_alike}, see tables/ambiguities_{name}.csv")
        )
    for state in found.fronts:
        blocks.append(readable_front(result, state, clock))
        blocks += [Text(each) for each in left_over(state, found.noise_test)]
    blocks.append(Text(column_note(result.recipe.selection.label), page_only=True))
    return Section(f"{name}: candidates", [*blocks, Picture(f"front_{name}")])


def left_over(state: str, test: NoiseTest) -> list[str]:
    """A line on what the selected terms leave of the rows, where their noise is known."""
    if (left := test.left.get(state)) is None:
        return []
    return [
        f"left over of {state}': {left.chi_squared:.3g} times the noise, "
        f"autocorrelation {left.autocorrelation:.2f} (1 and 0 where noise alone is left)"
    ]


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
    terms, left = result.discovery.model.terms(state), result.discovery.noise_test.left.get(state)
    return {
        "terms": terms,
        "n_terms": chosen.n_terms,
        "r2_test": chosen.r2_test,
        "r2_train": chosen.r2_train,
        result.recipe.selection.label: float(scores.min()),
        "chi_squared": left and left.chi_squared,
        "residual_autocorrelation": left and left.autocorrelation,
        "share": chosen.share,
        "inclusion": dict(zip(chosen.terms, chosen.inclusion.tolist(), strict=True)),
        "text": equation_text(state, terms),
    }
