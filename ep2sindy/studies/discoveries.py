"""Candidates of a discovery in a report: the fronts, and what the samples say of its model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import compress

import numpy as np
import pandas as pd
from jaxtyping import Float

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.result import Discovery
from ep2sindy.estimation.estimate import Estimate, Rival
from ep2sindy.figures.fronts import front_figure
from ep2sindy.forecasting.evaluation import Evaluation
from ep2sindy.forecasting.skill import ForecastSkill
from ep2sindy.library.equations import equation_text
from ep2sindy.library.units import Clock
from ep2sindy.model.model import SparseModel, model_of
from ep2sindy.regression.ambiguity import usable_terms
from ep2sindy.regression.front import Candidate, ParetoFront, fit_support
from ep2sindy.regression.rows import Formulation
from ep2sindy.report.document import Equation, Result, Table, Text
from ep2sindy.report.report import Report
from ep2sindy.report.results import Metric, Metrics, ResultTable, View
from ep2sindy.studies.processes import ComparedProcess
from ep2sindy.studies.study import Coefficients
from ep2sindy.studies.sustained import SUSTAINED_MODEL, SustainedModel
from ep2sindy.studies.views import EVALUATED, EVALUATION, best_run, found_model

# What the columns of a front mean; RULES explains the labels of the selection rules.
COLUMNS = (
    "R2: of the derivative, on rows held out from the fit where there are any; fraction: of the "
    "bootstraps that proposed these terms."
)
RULES = {
    "d_pareto": "d_pareto: distance to the corner of no error and no terms",
    "deviance": "deviance: -2 log likelihood of the trajectories plus the penalties of all terms, "
    "above the least",
}
FRONT = (
    "Error against number of terms: every support that the search proposed, and the best of each "
    "size; the star is selected. Carets at the upper edge: models far worse than none."
)
SCORED = (
    "Score against number of terms, the best of each size; the star is selected. States and "
    "coefficients were estimated together: there are no rows to have an error."
)
NOISE = (
    "Noise: standard deviation of what the model leaves of the samples. Memory: its correlation "
    "from one sample to the next, 0 for white noise. Grows: how much of its variance grows with "
    "the square of the state. Kurtosis: 3 where it is normal, more with outliers."
)
FITS = (
    "The model explains the samples to within their noise: what is left looks like noise, and "
    "an exact trajectory is likelier than one that leaves the model."
)
REPLACED = (
    "This section is about the likeliest model of the search. The rule chose another one, which "
    "was not tested against the noise."
)


@dataclass(frozen=True, eq=False)
class CandidateRow:
    """A candidate of a front, or another fit of its equation next to them.

    lead: what another fit is, such as `thesis`.
    """

    candidate: Candidate
    is_selected: bool = False
    lead: str = ""

    def equation(self, clock: Clock) -> Equation:
        terms = {name: clock.seconds * coef for name, coef in self.candidate.coef_by_term.items()}
        mark = "  <- selected" if self.is_selected else ""
        return Equation(self.candidate.equation, terms, lead=self.lead, mark=mark)


def candidate_metrics(label: str) -> Metrics[CandidateRow]:
    """Columns of a front. label: the name of the scores."""
    return [
        Metric("equation", lambda row: row.candidate.equation),
        Metric("n_terms", lambda row: row.candidate.n_terms, View.ALL, "terms", "{}"),
        Metric("r2", lambda row: row.candidate.r2, View.SCREEN, "R2", "{:.3f}"),
        Metric("r2_test", lambda row: row.candidate.r2_test, View.FILES | View.HEADLINE),
        Metric("r2_train", lambda row: row.candidate.r2_train),
        Metric(label, lambda row: row.candidate.score, View.ALL, label, "{:.3f}"),
        Metric("fraction", lambda row: row.candidate.fraction, View.SHOWN, format="{:.2f}"),
        Metric("selected", lambda row: row.is_selected),
        Metric(
            "text", lambda row: equation_text(row.candidate.equation, row.candidate.coef_by_term)
        ),
    ]


def candidate_rows(front: ParetoFront) -> list[CandidateRow]:
    return [CandidateRow(each, each is front.best) for each in front.candidates]


def add_candidates(
    report: Report,
    name: str,
    found: Discovery,
    *,
    note: str = "",
    beside: Mapping[str, Sequence[CandidateRow]] | None = None,
) -> None:
    """Add the candidates of every state, their front, and terms that the data cannot distinguish.

    name: of the library. note: how the rule decided. next to: other fits of the equations, by
    state.
    """
    library, label = found.model.library, found.method.selection.label
    words = f"{len(library)} terms in {', '.join(library.variables)}; selection: "
    report.section(f"{name}: candidate equations", f"{words}{found.method.selection}")
    report.summary.setdefault("notes", {})[name] = note
    report.add(
        *([f"selected: {note}"] if note else []), *(f"note: {n}" for n in found.data_warnings)
    )
    report.add(*(f"note: {each.message}" for each in found.ambiguities if each.exact))
    if n_alike := sum(not each.exact for each in found.ambiguities):
        file = f"tables/ambiguities_{name}.csv"
        report.add(f"note: nearly proportional terms: {n_alike}, see {file}")
    for state in found.fronts:
        report.add(_front_table(found, state, (beside or {}).get(state, ())))
        if (left := found.noise_test.left.get(state)) is not None:
            rate = f"{state}', the rate of change of {state}"
            report.add(
                f"unexplained: {left.text(rate)}; correlation of what is left from one row to the "
                f"next: {left.autocorrelation:.2f} (0 for noise)"
            )
    report.add(Text(column_note(label), page_only=True))
    caption = FRONT if any(front.has_errors for front in found.fronts.values()) else SCORED
    report.figure(f"front_{name}", partial(front_figure, found.fronts, label=label), caption)
    rows = [row for front in found.fronts.values() for row in candidate_rows(front)]
    report.samples(f"front_{name}", ResultTable(rows, candidate_metrics(label)).csv())
    alike = [(each.exact, " ".join(each.terms), each.message) for each in found.ambiguities]
    columns = ["exact", "terms", "message"]
    report.samples(f"ambiguities_{name}", pd.DataFrame(alike, columns=columns))


def _front_table(found: Discovery, state: str, beside: Sequence[CandidateRow]) -> Table:
    """Table of the candidates, the selected one in bold; below, the final and other fits."""
    clock, label, terms = found.model.clock, found.method.selection.label, found.model.terms(state)
    own = candidate_rows(found.fronts[state])
    if terms not in [row.candidate.coef_by_term for row in own if row.is_selected]:
        own.append(CandidateRow(Candidate.of(state, terms), lead="weighted"))
    shown = Metric[CandidateRow]("model", lambda row: row.equation(clock), View.SCREEN)
    rows = [*own, *beside]
    return Table(
        ResultTable(rows, [*candidate_metrics(label), shown]).screen(),
        title=f"candidates for {state}' [{clock.rate_unit(found.model.units[state])}]",
        bold=[k for k, row in enumerate(rows) if row.is_selected],
        italic=range(len(own), len(rows)),
    )


def column_note(label: str) -> str:
    """Explanation of the columns of the fronts."""
    rule = RULES.get(label, f"{label}: the score of the selection, least selected")
    # Candidates scored by trajectories have neither rows nor bootstraps.
    return f"{rule}." if label == "deviance" else f"{rule}. {COLUMNS}"


RIVALS: Metrics[Rival] = [
    Metric("state", lambda rival: rival.state, View.SHOWN, "equation", "{}'"),
    Metric(
        "terms", lambda rival: ", ".join(rival.terms), View.SHOWN,
        format=lambda terms: terms.replace("*", " "),
    ),
    Metric(
        "odds", lambda rival: rival.odds, View.SHOWN, "posterior odds against the chosen",
        lambda odds: f"1:{1.0 / odds:.3g}",
    ),
]  # fmt: skip
ESTIMATE: Metrics[Estimate] = [
    Metric(
        "noise_std", lambda found: by_state(found, found.noise_std), View.SHOWN, "noise (std)",
    ),
    Metric(
        "noise_share",
        lambda found: by_state(found, found.noise_std / _spread(found)),
        View.SHOWN, "of the state's std", lambda value: f"{100.0 * value:.2g} %",
    ),
    Metric("memory", lambda found: by_state(found, found.memory), View.SHOWN, format="{:.2f}"),
    Metric(
        "noise_growth", lambda found: by_state(found, found.growth), View.SHOWN, "grows",
        lambda value: f"{100.0 * value:.3g} %",
    ),
    Metric(
        "noise_kurtosis", lambda found: by_state(found, found.kurtosis), View.SHOWN, "kurtosis",
        lambda value: f"{value:.3g}".replace("nan", ""),
    ),
    Metric("delays_s", lambda found: by_state(found, found.delays_s)),
    Metric("data_warnings", lambda found: list(found.data_warnings)),
    Metric("flow_error", lambda found: found.flow_error),
    Metric("lack_of_fit", lambda found: found.lack_of_fit or None),
    Metric("too_few_samples", lambda found: found.too_few_samples or None),
]  # fmt: skip


def add_estimate(report: Report, name: str, found: Discovery) -> None:
    """Add the noise of the samples, the lack of fit of the model, and other possible supports.

    name: of the library or signal. found: by a search that estimates states and coefficients.
    """
    estimate = found.estimate
    assert estimate is not None
    report.section(f"{name}: noise of the samples, and other supports", level=3)
    if not found.noise_test.tested:
        report.add(Text(REPLACED, warning=True))
    rows, title = ResultTable([estimate], ESTIMATE), "noise of the samples"
    report.table(f"samples_{name}", rows, by_state=True, title=title, note=NOISE)
    report.add(Text(estimate.lack_of_fit or FITS, warning=bool(estimate.lack_of_fit)))
    if estimate.too_few_samples:
        report.add(Text(estimate.too_few_samples, warning=True))
    rivals, title = ResultTable(estimate.rivals, RIVALS), "other supports that may be"
    report.table(f"other_supports_{name}", rivals, title=title)
    if not estimate.rivals and not estimate.lack_of_fit:
        report.add("No other support of an equation has posterior odds above 1:1000.")


def by_state(found: Estimate, values: np.ndarray) -> dict[str, float]:
    """Values of the states that were measured."""
    pairs = zip(found.model.states, np.asarray(values).tolist(), strict=True)
    return dict(compress(pairs, np.isfinite(found.noise_std)))


def _spread(found: Estimate) -> Float[np.ndarray, " n_states"]:
    """Standard deviation of every state in the first record."""
    spread: np.ndarray = found.runs[0].columns(found.model.states).std(axis=0)
    return spread


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
    def note(self) -> str:
        """How a rule for whole models decided; other notes are shown as warnings or estimates."""
        return self.discovery.note if self.discovery.method.selection.basis == "runs" else ""

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
