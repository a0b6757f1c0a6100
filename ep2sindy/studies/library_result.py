"""What one library finds, and how it reads: candidates, the samples' noise, free runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import compress
from typing import Any

import numpy as np
import pandas as pd

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.choice import LeftOver, NoiseTest
from ep2sindy.discovery.discover import Discovery
from ep2sindy.discovery.method import AnyMethod, Regression
from ep2sindy.estimation.estimate import Estimate
from ep2sindy.library.equations import equation_text
from ep2sindy.library.units import Clock
from ep2sindy.model.free_run import FreeRun, free_run
from ep2sindy.model.model import SparseModel, coef_matrix
from ep2sindy.regression.ambiguity import usable_terms
from ep2sindy.regression.rows import RegressionRows
from ep2sindy.report.document import Block, Equation, Picture, Section, Table, Text, places
from ep2sindy.report.results import Metric, Metrics, ResultTable, View, facts
from ep2sindy.search.front import Candidate, ParetoFront, fit_support
from ep2sindy.selection.rule import selected
from ep2sindy.studies.living import Living
from ep2sindy.studies.term_roles import Roles

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
NOISE = (
    "Noise: standard deviation of what the model leaves of the samples. Memory: its correlation "
    "from one sample to the next, 0 for white noise. Grows: how much of its variance grows with "
    "the square of the state. Kurtosis: 3 where it is normal, more with outliers."
)

FITS = (
    "The model explains the samples as far as their noise: what is left looks like noise, and "
    "an exact trajectory is likelier than one that leaves the model."
)


@dataclass(frozen=True, eq=False)
class LibraryResult:
    """One library's discovery and its selected model; the published terms, fitted to our data.

    given: the published terms as printed, by state. living: a model that lives on its own; None
    where it was not asked for, or the library has inputs. roles: of its terms. elsewhere: the
    selected model over the records beside the first.
    """

    recipe: AnyMethod
    discovery: Discovery
    selected: FreeRun
    given: Mapping[str, Mapping[str, float]]
    refitted: Mapping[str, Candidate]
    published: FreeRun | None
    living: Living | None = None
    roles: Roles | None = None
    elsewhere: Sequence[FreeRun] = ()

    @property
    def label(self) -> str:
        """What the scores are called."""
        return self.recipe.selection.label

    def front_tables(self, name: str) -> dict[str, pd.DataFrame]:
        """The fronts as in the thesis's Tables I-III, and terms that the data cannot tell apart."""
        found = self.discovery
        fronts = [
            ResultTable(candidate_rows(front), _columns(self.label, front)).csv()
            for front in found.fronts.values()
        ]
        ambiguities = [(a.exact, " ".join(a.terms), a.message) for a in found.ambiguities]
        return {
            f"front_{name}": pd.concat(fronts),
            f"ambiguities_{name}": pd.DataFrame(ambiguities, columns=["exact", "terms", "message"]),
        }

    def sections(self, name: str, data: Trajectory) -> list[Section]:
        found = [_candidates_section(name, self, data.clock)]
        if (estimate := self.discovery.estimate) is not None:
            found.append(estimate_section(name, estimate, data))
        return found

    def summary(self) -> dict[str, Any]:
        states, estimate = self.discovery.fronts, self.discovery.estimate
        return {
            "equations": {s: facts(_chosen(self, s), _equation(self.label)) for s in states},
            "trajectory": facts(self.selected, TRAJECTORY),
            "thesis_terms": self.published and _published_summary(self.published, self.refitted),
            "living": self.living and self.living.summary(),
            "roles": self.roles and self.roles.summary(),
        } | ({"estimate": estimate_summary(estimate)} if estimate else {})

    def headline(self, name: str) -> dict[str, float]:
        chosen = {f"{name}/{state}": _chosen(self, state) for state in self.discovery.chosen}
        return (
            ResultTable({name: self.selected}, TRAJECTORY).headline()
            | ResultTable(chosen, _equation(self.label)).headline()
        )


@dataclass(frozen=True, eq=False)
class Row:
    """A candidate of a front.

    terms: as the model has them, which may be weighted otherwise. left: of the noise, by the terms
    of the model; None where that is not known.
    """

    candidate: Candidate
    is_selected: bool
    terms: Mapping[str, float]
    left: LeftOver | None = None


TRAJECTORY: Metrics[FreeRun] = [
    Metric(
        "f_kHz", lambda run: 1e-3 * run.frequency_Hz[run.model.states[0]],
        View.JSON | View.HEADLINE,
    ),
    Metric("nrmse", lambda run: run.nrmse, View.JSON | View.HEADLINE),
    Metric("diverged", lambda run: run.rollout.diverged, View.JSON),
]  # fmt: skip


def _columns(label: str, front: ParetoFront) -> Metrics[Row]:
    """Of a table of candidates; label: what their scores are called."""
    r2: Metrics[Row] = [
        Metric("r2_test", lambda row: row.candidate.r2_test),
        Metric("r2_train", lambda row: row.candidate.r2_train),
    ]
    return [
        Metric("equation", lambda row: row.candidate.equation),
        Metric("n_terms", lambda row: row.candidate.n_terms),
        *([] if front.problem is None else r2),  # a search of trajectories has no rows
        Metric(label, lambda row: row.candidate.score),
        Metric("share", lambda row: row.candidate.share),
        Metric("selected", lambda row: row.is_selected),
        Metric("text", lambda row: candidate_text(row.candidate)),
    ]


def _equation(label: str) -> Metrics[Row]:
    """Of the selected candidate."""
    compared = View.JSON | View.HEADLINE
    return [
        Metric("terms", lambda row: row.terms),
        Metric("r2_test", lambda row: row.candidate.r2_test, compared),
        Metric("n_terms", lambda row: row.candidate.n_terms, compared),
        Metric("r2_train", lambda row: row.candidate.r2_train),
        Metric(label, lambda row: row.candidate.score, compared),
        Metric("chi_squared", lambda row: row.left and row.left.chi_squared),
        Metric("residual_autocorrelation", lambda row: row.left and row.left.autocorrelation),
        Metric("share", lambda row: row.candidate.share),
        Metric("inclusion", lambda row: _inclusion(row.candidate)),
        Metric("text", lambda row: equation_text(row.candidate.equation, row.terms)),
    ]


def _inclusion(chosen: Candidate) -> dict[str, float]:
    return dict(zip(chosen.terms, chosen.inclusion.tolist(), strict=True))


def candidate_rows(front: ParetoFront) -> list[Row]:
    chosen = selected(front, front.scores)
    return [Row(each, each is chosen, each.coef_by_term) for each in front.candidates]


def _chosen(result: LibraryResult, state: str) -> Row:
    found = result.discovery
    chosen = selected(found.fronts[state], found.scores[state])
    return Row(chosen, True, found.model.terms(state), found.noise_test.left.get(state))


def refit(
    found: Discovery,
    published: Mapping[str, Mapping[str, float]],
    rows: Regression,
    runs: Sequence[Trajectory],
    rng: np.random.Generator,
) -> dict[str, Candidate]:
    """Published terms fitted to our rows, where the data can tell them from others."""
    fits = {}
    problems = _rows_by_state(found, rows, runs, rng) if published else {}
    for state, terms in published.items():
        if state in found.fronts:
            problem = problems[state]
            at_hand = set(compress(problem.term_names, usable_terms(problem)))
            if set(terms) <= at_hand:
                fits[state] = fit_support(problem, state, list(terms))
    return fits


def _rows_by_state(
    found: Discovery, rows: Regression, runs: Sequence[Trajectory], rng: np.random.Generator
) -> dict[str, RegressionRows]:
    """By state the rows that were searched; of a search of trajectories, rows for a fit."""
    fronts = found.fronts.values()
    if known := {front.equation: front.problem for front in fronts if front.problem is not None}:
        return known
    problems = rows.formulation.assemble(runs, found.model.library, rng=rng)
    return {state: problem for problem in problems for state in problem.equations}


def run_refitted(
    found: Discovery, refitted: Mapping[str, Candidate], data: Trajectory, n_samples: int
) -> FreeRun | None:
    if set(refitted) != set(data.state_names):
        return None
    coef = [refitted[state].coef_by_term for state in data.state_names]
    model = SparseModel(
        library=found.model.library,
        states=data.state_names,
        coef=coef_matrix(found.model.library, coef),
        units=data.units,
        provenance={**found.model.provenance, "search": "published terms, refitted"},
    )
    return free_run(model, data, n_samples=n_samples)


def _candidates_section(name: str, result: LibraryResult, clock: Clock) -> Section:
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
    blocks.append(Text(column_note(result.label), page_only=True))
    return Section(f"{name}: candidates", [*blocks, Picture(f"front_{name}")])


def left_over(state: str, test: NoiseTest) -> list[str]:
    """A line on what the selected terms leave of the rows, where their noise is known."""
    if (left := test.left.get(state)) is None:
        return []
    return [
        f"left over of {state}': {left.chi_squared:.3g} times the noise, "
        f"autocorrelation {left.autocorrelation:.2f} (1 and 0 where noise alone is left)"
    ]


def candidate_text(candidate: Candidate) -> str:
    """`n_i' = -2.62e+05 n_i + 5.48e-14 n_i n_n`."""
    return equation_text(candidate.equation, candidate.coef_by_term)


def readable_front(result: LibraryResult, state: str, clock: Clock) -> Table:
    """Candidates, the selected one bold; below them the last fit, and what was published."""
    label = result.label
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


def _published_summary(run: FreeRun, refitted: Mapping[str, Candidate]) -> dict[str, Any]:
    """The published terms fitted to our data."""
    return {
        "equations": {
            name: {
                "terms": run.model.terms(name),
                "r2_test": candidate.r2_test,
                "text": candidate_text(candidate),
            }
            for name, candidate in refitted.items()
        },
        "trajectory": facts(run, TRAJECTORY),
    }


def estimate_section(name: str, found: Estimate, data: Trajectory) -> Section:
    """What the samples say of their noise, whether the model explains them, and what else may."""
    blocks: list[Block] = [
        Table(noise_table(found, data), title="noise of the samples", note=NOISE),
        Text(found.misfit or FITS, warning=bool(found.misfit)),
    ]
    if found.few:
        blocks.append(Text(found.few, warning=True))
    if found.rivals:
        rivals = [
            (f"{each.state}'", ", ".join(t.replace("*", " ") for t in each.terms), odds(each.odds))
            for each in found.rivals
        ]
        rows = pd.DataFrame(rivals, columns=["equation", "terms", "odds against the chosen"])
        blocks.append(Table(rows, title="other supports that may be"))
    elif not found.misfit:
        blocks.append(Text("No other support of an equation has odds above 1:1000."))
    return Section(f"{name}: what the samples say", blocks, level=3)


def noise_table(found: Estimate, data: Trajectory) -> pd.DataFrame:
    """By state: size of the noise, in SI and beside the state's spread, and what it is like."""
    rows = []
    for k, state in enumerate(found.model.states):
        noise, spread = float(found.noise_std[k]), float(data.columns([state]).std())
        rows.append(
            {
                "state": state,
                "noise (std)": f"{noise:.3g} {data.units[state]}".removesuffix(" 1"),
                "of the state's std": f"{100.0 * noise / spread:.2g} %",
                "memory": f"{found.memory[k]:.2f}",
                "grows": f"{100.0 * found.growth[k]:.3g} %",
                "kurtosis": f"{found.kurtosis[k]:.3g}".replace("nan", ""),
            }
        )
    return pd.DataFrame(rows)


def odds(value: float) -> str:
    """`1:27`; 1:1 is even."""
    return f"1:{1.0 / value:.3g}"


def estimate_summary(found: Estimate) -> dict[str, Any]:
    """What `summary.json` says, in SI."""
    states = found.model.states
    return {
        "noise_std": dict(zip(states, np.asarray(found.noise_std).tolist(), strict=True)),
        "memory": dict(zip(states, np.asarray(found.memory).tolist(), strict=True)),
        "noise_growth": dict(zip(states, np.asarray(found.growth).tolist(), strict=True)),
        "noise_kurtosis": dict(zip(states, np.asarray(found.kurtosis).tolist(), strict=True)),
        "delays_s": dict(zip(states, np.asarray(found.delays_s).tolist(), strict=True)),
        "remarks": list(found.remarks),
        "flow_error": found.flow_error,
        "misfit": found.misfit or None,
        "few": found.few or None,
        "rivals": [
            {"state": r.state, "terms": list(r.terms), "odds": r.odds} for r in found.rivals
        ],
    }
