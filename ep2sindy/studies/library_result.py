"""One library's result in the study of libraries, and the tables of all of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import compress

import numpy as np

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.result import Discovery
from ep2sindy.forecasting.evaluation import Evaluation
from ep2sindy.forecasting.skill import ForecastSkill
from ep2sindy.model.model import SparseModel, model_of
from ep2sindy.regression.ambiguity import usable_terms
from ep2sindy.regression.front import Candidate, fit_support
from ep2sindy.regression.rows import Formulation
from ep2sindy.report.document import Result, Table, Text
from ep2sindy.report.report import Report
from ep2sindy.report.results import ResultTable
from ep2sindy.studies.candidates import CandidateRow, candidate_metrics
from ep2sindy.studies.processes import ComparedProcess
from ep2sindy.studies.study import Coefficients
from ep2sindy.studies.sustained import SUSTAINED_MODEL, SustainedModel
from ep2sindy.studies.views import EVALUATED, EVALUATION, best_run, found_model

FROM_DERIVATIVES = (
    "Self-sustained models, which free runs select, are run over held-out time; the equations "
    "that fits of derivatives select, and the thesis's terms fitted here, over the record from its "
    "first sample."
)


@dataclass(frozen=True, eq=False)
class LibraryResult:
    """One library's discovery with its selected model, and the published terms fitted to our data.

    runs: free runs of the selected model over every record. thesis: the published coefficients as
    printed, by state. refitted: their terms fitted to our rows, and published: the run of that
    model over the first record; None if a state has none. sustained: a model that oscillates on its
    own; None if none was asked for, or if the library has inputs. processes: of that model, next to
    those of its zone, if the record gives them. skill: of forecasts by the self-sustained model
    over its held-out part, or else by the selected one over the last quarter of the record, which
    it was fitted to; None if there are none.
    """

    discovery: Discovery
    runs: Sequence[Evaluation]
    thesis: Coefficients
    refitted: Mapping[str, Candidate]
    published: Evaluation | None
    sustained: SustainedModel | None
    processes: Sequence[ComparedProcess]
    skill: ForecastSkill | None

    @property
    def by_runs(self) -> bool:
        """Whether the selection runs or refines whole models, rather than scoring candidates."""
        return self.discovery.method.selection.basis == "runs"

    @property
    def how(self) -> str:
        """How the selected equations were found."""
        if self.by_runs:
            return "selected by free runs or refinements"
        if self.discovery.estimate is not None:
            return "estimated together with the states"
        return "selected by their derivatives"

    @property
    def note(self) -> str:
        """How a rule for whole models decided; other notes are shown as warnings or estimates."""
        return self.discovery.note if self.by_runs else ""

    @property
    def beside(self) -> dict[str, list[CandidateRow]]:
        """The published equations as printed, and with their terms fitted to our rows, by state."""
        return {
            state: [
                CandidateRow(Candidate.of(state, self.thesis[state]), lead="thesis"),
                CandidateRow(fit, lead="its terms here"),
            ]
            for state, fit in self.refitted.items()
        }


def add_evaluations(
    report: Report, results: Mapping[str, LibraryResult], files: Sequence[str]
) -> None:
    """Add how all models run: self-sustained, selected over every record, and published."""
    runs: dict[str, Evaluation] = {}
    for name, result in results.items():
        if result.sustained is not None:
            runs[f"{name}_sustained"] = result.sustained.run
        runs |= {name: result.runs[0]}
        others = zip(files[1:], result.runs[1:], strict=True)
        runs |= {f"{name}, {file}": run for file, run in others}
        runs |= {f"{name}_thesis_terms": result.published} if result.published else {}
    is_sustained = any(result.sustained is not None for result in results.values())
    rows = ResultTable(runs, EVALUATION)
    shown = Table(
        rows.screen("model", by_state=True),
        title="run freely from one sample",
        note=f"{FROM_DERIVATIVES} {EVALUATED}" if is_sustained else EVALUATED,
    )
    report.section("How the models run")
    report.table("evaluations", rows, heading="model", shown=shown)


def add_tables(report: Report, results: Mapping[str, LibraryResult]) -> None:
    """Add tables of all libraries whose facts stand in the sections: for files and headline."""
    rows: dict[str, CandidateRow] = {}
    for name, result in results.items():
        chosen, refitted = result.discovery.chosen.items(), result.refitted.items()
        rows |= {f"{name}/{s}": CandidateRow(each, True) for s, each in chosen}
        rows |= {f"{name}_thesis_terms/{s}": CandidateRow(each) for s, each in refitted}
    label = next(iter(results.values())).discovery.method.selection.label
    report.table(
        "equations", ResultTable(rows, candidate_metrics(label)), heading="of", shown=False
    )
    sustained = {
        f"{name}_sustained": each.sustained for name, each in results.items() if each.sustained
    }
    if sustained:
        report.table(
            "sustained", ResultTable(sustained, SUSTAINED_MODEL), heading="model", shown=False
        )


def find_best(results: Mapping[str, LibraryResult], n_records: int) -> Result:
    """The self-sustained model, or the best of those that were run.

    A self-sustained model was asked to sustain its oscillation, so its free run heads the result;
    any other model, its forecasts.
    """
    sustained = {
        name: each.sustained for name, each in results.items() if each.sustained is not None
    }
    if sustained:
        best = best_run({name: each.run for name, each in sustained.items()})
        run, found = sustained[best].run, sustained[best].discovery
        picture = "trajectories" if run.cycle is None else f"free_run_{best}"
        return found_model(
            best, run, file=f"{best}_sustained", picture=picture, more=[Text(f"{found.note}.")],
            where="held-out time", held=found.constraint,
        )  # fmt: skip
    runs = {n: max(r.runs, key=lambda run: run.rank) for n, r in results.items()}
    best = best_run(runs)
    found, test = results[best].discovery, results[best].discovery.noise_test
    return found_model(
        best, runs[best], file=best, picture="trajectories", seen=True,
        where=f"the worst of {n_records} records" if n_records > 1 else "the record",
        lack_of_fit=test.lack_of_fit, held=found.constraint,
        more=[Text(test.note, warning=True)] if test.note else [],
    )  # fmt: skip


def refit(
    found: Discovery,
    published: Coefficients,
    formulation: Formulation,
    runs: Sequence[Trajectory],
    rng: np.random.Generator,
) -> dict[str, Candidate]:
    """Published terms fitted to our rows, where the data can tell the terms from others.

    They are the searched rows; after a search of trajectories, rows assembled for the fit.
    """
    if not published:
        return {}
    fronts = found.fronts.values()
    problems = {front.equation: front.problem for front in fronts if front.problem is not None}
    if not problems:
        assembled = formulation.assemble(runs, found.model.library, rng=rng)
        problems = {state: problem for problem in assembled for state in problem.equations}
    fits = {}
    for state, terms in published.items():
        problem = problems.get(state)
        if problem and set(terms) <= set(compress(problem.library.names, usable_terms(problem))):
            fits[state] = fit_support(problem, state, list(terms))
    return fits


def refitted_model(found: Discovery, refitted: Mapping[str, Candidate]) -> SparseModel | None:
    """The model of the published terms with their coefficients here; None if a state has none."""
    model = found.model
    if set(refitted) != set(model.states):
        return None
    return model_of(
        model.library,
        {state: refitted[state].coef_by_term for state in model.states},
        units=model.units,
        provenance={**model.provenance, "search": "published terms, refitted"},
        clock=model.clock,
    )
