"""Result of one library and its presentation: candidates, noise of the samples, free runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import compress
from typing import Any

import numpy as np
import pandas as pd

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.choice import NoiseTest
from ep2sindy.discovery.method import Regression
from ep2sindy.discovery.result import Discovery
from ep2sindy.estimation.estimate import Estimate, Rival
from ep2sindy.forecasting.evaluation import Evaluation, evaluate
from ep2sindy.forecasting.skill import ForecastSkill
from ep2sindy.library.equations import equation_text
from ep2sindy.library.units import Clock
from ep2sindy.model.model import SparseModel, coef_matrix
from ep2sindy.regression.ambiguity import usable_terms
from ep2sindy.regression.front import Candidate, LeftOver, ParetoFront, fit_support
from ep2sindy.regression.rows import RegressionRows
from ep2sindy.report.document import Block, Equation, Picture, Section, Table, Text, places
from ep2sindy.report.results import Metric, Metrics, ResultTable, View, facts
from ep2sindy.signals.spectrum import dominant_frequency
from ep2sindy.studies.balance import ModelBalance
from ep2sindy.studies.living import Living

# What the columns of a front mean; RULES explains the labels of the selection rules.
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

REPLACED = (
    "This section is about the likeliest model of the search. The rule chose another one, which "
    "was not tested against the noise."
)


@dataclass(frozen=True, eq=False)
class LibraryResult:
    """One library's discovery with its selected model, and the published terms fitted to our data.

    given: the published coefficients as printed, by state. living: a model that oscillates on its
    own; None if none was asked for, or if the library has inputs. balance: of its zone, beside
    the living model. elsewhere: free runs of the selected model over the records after the first.
    skill: of forecasts by the living model over its held-out part, or else by the selected one over
    the last quarter of the record, which it was fitted to; None if there are none.
    """

    discovery: Discovery
    selected: Evaluation
    given: Mapping[str, Mapping[str, float]]
    refitted: Mapping[str, Candidate]
    published: Evaluation | None
    living: Living | None = None
    balance: ModelBalance | None = None
    elsewhere: Sequence[Evaluation] = ()
    skill: ForecastSkill | None = None

    @property
    def runs(self) -> list[Evaluation]:
        """Free runs of the selected model over every record."""
        return [self.selected, *self.elsewhere]

    @property
    def label(self) -> str:
        """The name of the selection score."""
        return self.discovery.method.selection.label

    @property
    def by_runs(self) -> bool:
        """Whether the selection runs or refines whole models, rather than scoring candidates."""
        return self.discovery.method.selection.basis == "runs"

    @property
    def how(self) -> str:
        """How the equations shown first were found: those that live, if such were searched for."""
        if self.living is not None:
            return "selected by free runs"
        if self.by_runs:
            return "selected by free runs or refinements"
        if self.discovery.estimate is not None:
            return "estimated together with the states"
        return "selected by their derivatives"

    @property
    def decision(self) -> str:
        """How a rule for whole models decided; other notes are shown as warnings or estimates."""
        return self.discovery.note if self.by_runs else ""

    def front_tables(self, name: str) -> dict[str, pd.DataFrame]:
        """Fronts as in the thesis's Tables I-III, and terms that the data cannot tell apart."""
        found = self.discovery
        fronts = [self._front_table(front) for front in found.fronts.values()]
        ambiguities = [(a.exact, " ".join(a.terms), a.message) for a in found.ambiguities]
        return {
            f"front_{name}": pd.concat(fronts),
            f"ambiguities_{name}": pd.DataFrame(ambiguities, columns=["exact", "terms", "message"]),
        }

    def _front_table(self, front: ParetoFront) -> pd.DataFrame:
        table = ResultTable(candidate_rows(front), candidate_metrics(self.label)).csv()
        without = [] if front.has_errors else ["r2_test", "r2_train"]
        return table.drop(columns=without)  # a search of trajectories has no regression rows

    def sections(self, name: str, data: Trajectory) -> list[Section]:
        found = [_candidates_section(name, self, data.clock)]
        if (estimate := self.discovery.estimate) is not None:
            of_model = self.discovery.noise_test.tested
            found.append(estimate_section(name, estimate, data, of_model=of_model))
        return found

    def summary(self) -> dict[str, Any]:
        states, estimate = self.discovery.fronts, self.discovery.estimate
        metrics = candidate_metrics(self.label)
        return {
            "equations": {s: facts(_chosen(self, s), metrics) for s in states},
            "note": self.decision,
            "trajectory": facts(self.selected, TRAJECTORY),
            "thesis_terms": self.published and _published_summary(self.published, self.refitted),
            "living": self.living and self.living.summary(),
            "balance": self.balance and self.balance.summary(),
            "forecast": self.skill and self.skill.summary(),
        } | ({"estimate": facts(estimate, ESTIMATE)} if estimate else {})

    def headline(self, name: str) -> dict[str, float]:
        chosen = {f"{name}/{state}": _chosen(self, state) for state in self.discovery.chosen}
        return (
            ResultTable({name: self.selected}, TRAJECTORY).headline()
            | ResultTable(chosen, candidate_metrics(self.label)).headline()
        )


@dataclass(frozen=True, eq=False)
class CandidateRow:
    """A candidate of a front.

    terms: coefficients as in the model, which may come from a weighted fit. left: statistics of the
    residuals of the model's terms relative to the noise; None if the noise is not known.
    """

    candidate: Candidate
    is_selected: bool
    terms: Mapping[str, float]
    left: LeftOver | None = None

    @property
    def inclusion(self) -> dict[str, float]:
        return dict(zip(self.candidate.terms, self.candidate.inclusion.tolist(), strict=True))


TRAJECTORY: Metrics[Evaluation] = [
    Metric(
        "f_kHz", lambda run: 1e-3 * run.frequency_Hz[run.model.states[0]],
        View.JSON | View.HEADLINE,
    ),
    Metric("nrmse", lambda run: run.nrmse, View.JSON | View.HEADLINE),
    Metric("diverged", lambda run: run.rollout.diverged, View.JSON),
]  # fmt: skip


def candidate_metrics(label: str) -> Metrics[CandidateRow]:
    """Columns of a front, and facts on the selected candidate. label: the name of the scores."""
    return [
        Metric("equation", lambda row: row.candidate.equation, View.CSV),
        Metric("terms", lambda row: row.terms, View.JSON),
        Metric("n_terms", lambda row: row.candidate.n_terms, View.ALL, "terms", "{}"),
        Metric("r2_test", lambda row: row.candidate.r2_test, View.ALL, "R2 test", "{:.3f}"),
        Metric("r2_train", lambda row: row.candidate.r2_train, View.SHOWN, "R2 train", "{:.3f}"),
        Metric(label, lambda row: row.candidate.score, View.ALL, label, "{:.3f}"),
        Metric("chi_squared", lambda row: row.left and row.left.chi_squared, View.JSON),
        Metric(
            "residual_autocorrelation", lambda row: row.left and row.left.autocorrelation, View.JSON
        ),
        Metric("share", lambda row: row.candidate.share, View.SHOWN, format="{:.2f}"),
        Metric("inclusion", lambda row: row.inclusion, View.JSON),
        Metric("selected", lambda row: row.is_selected, View.CSV),
        Metric("text", lambda row: equation_text(row.candidate.equation, row.terms)),
    ]


def candidate_rows(front: ParetoFront) -> list[CandidateRow]:
    best = front.best
    return [CandidateRow(each, each is best, each.coef_by_term) for each in front.candidates]


def _chosen(result: LibraryResult, state: str) -> CandidateRow:
    found = result.discovery
    chosen = found.fronts[state].best
    return CandidateRow(chosen, True, found.model.terms(state), found.noise_test.left.get(state))


def refit(
    found: Discovery,
    published: Mapping[str, Mapping[str, float]],
    rows: Regression,
    runs: Sequence[Trajectory],
    rng: np.random.Generator,
) -> dict[str, Candidate]:
    """Published terms fitted to our rows, where the data can tell the terms from others."""
    fits = {}
    problems = _rows_by_state(found, rows, runs, rng) if published else {}
    for state, terms in published.items():
        if state in found.fronts:
            problem = problems[state]
            at_hand = set(compress(problem.library.names, usable_terms(problem)))
            if set(terms) <= at_hand:
                fits[state] = fit_support(problem, state, list(terms))
    return fits


def _rows_by_state(
    found: Discovery, rows: Regression, runs: Sequence[Trajectory], rng: np.random.Generator
) -> dict[str, RegressionRows]:
    """The searched rows by state; after a search of trajectories, rows assembled for a fit."""
    fronts = found.fronts.values()
    if known := {front.equation: front.problem for front in fronts if front.problem is not None}:
        return known
    problems = rows.formulation.assemble(runs, found.model.library, rng=rng)
    return {state: problem for problem in problems for state in problem.equations}


def run_refitted(
    found: Discovery, refitted: Mapping[str, Candidate], data: Trajectory, n_samples: int
) -> Evaluation | None:
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
    return evaluate(model, data, n_samples=n_samples)


def _candidates_section(name: str, result: LibraryResult, clock: Clock) -> Section:
    library, found = result.discovery.model.library, result.discovery
    blocks: list[Block] = [
        Text(
            f"{len(library)} terms in {', '.join(library.variables)}; "
            f"selection: {found.method.selection}"
        ),
        *([Text(f"selected: {result.decision}")] if result.decision else []),
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
        if (left := found.noise_test.left.get(state)) is not None:
            blocks.append(
                Text(
                    f"left over of {state}': {left.chi_squared:.3g} times {THE_NOISE}, "
                    f"autocorrelation {left.autocorrelation:.2f} (1 and 0 where noise alone is "
                    "left)"
                )
            )
    blocks.append(Text(column_note(result.label), page_only=True))
    return Section(f"{name}: candidates", [*blocks, Picture(f"front_{name}")])


# Nobody measured a simulation: what its samples show beside their smooth course is numerical.
THE_NOISE = "the noise of the samples (of a simulation: its numerical noise)"


def left_over_of_all(tests: Sequence[NoiseTest]) -> list[Text]:
    """What fits of derivatives leave beyond noise; nothing if they leave no more."""
    if not any(test.misfit for test in tests):
        return []
    left = [each for test in tests for each in test.left.values() if not each.leaves_noise]
    ratios = sorted(each.chi_squared for each in left)
    size = f"{ratios[0]:.3g} to {ratios[-1]:.3g} times {THE_NOISE}" if left else "more than noise"
    text = (
        f"The equations fitted to derivatives leave {size}: a state or a term is missing there, so "
        "they have no intervals; the free run above is what judges."
    )
    return [Text(text)]


def readable_front(result: LibraryResult, state: str, clock: Clock) -> Table:
    """Table of the candidates, the selected one in bold; below, the final and published fits."""
    found, front = result.discovery, result.discovery.fronts[state]
    rows, held_out = candidate_rows(front), front.held_out
    header, other = ("R2 test", "R2 train") if held_out else ("R2 train", "R2 test")

    def equation(terms: Mapping[str, float], lead: str = "", mark: str = "") -> Equation:
        shown = {name: clock.seconds * coef for name, coef in terms.items()}
        return Equation(state, shown, lead=lead, mark=mark)

    def marked(row: CandidateRow) -> Equation:
        return equation(row.terms, mark="  <- selected" if row.is_selected else "")

    metrics = [*candidate_metrics(result.label), Metric("model", marked, View.SCREEN)]
    table = ResultTable(rows, metrics).screen().drop(columns=other)
    more: list[dict[str, Any]] = []
    terms = found.model.terms(state)
    if terms not in [row.terms for row in rows if row.is_selected]:
        more.append({"model": equation(terms, "weighted")})
    n_own = len(rows) + len(more)
    if (here := result.refitted.get(state)) is not None:
        r2 = places(here.r2_test if held_out else here.r2_train, 3)
        more.append({"model": equation(result.given[state], "thesis")})
        fit = equation(here.coef_by_term, "its terms here")
        more.append({"terms": str(here.n_terms), header: r2, "model": fit})
    table = pd.concat([table, pd.DataFrame(more)], ignore_index=True).fillna("")
    for column in (header, "share"):  # empty after a search without rows, or without bootstraps
        if table[column].isin(["-", ""]).all():
            del table[column]
    unit = clock.rate_unit(found.model.units[state])
    return Table(
        table,
        title=f"candidates for {state}' [{unit}]",
        bold=[k for k, row in enumerate(rows) if row.is_selected],
        italic=range(n_own, len(rows) + len(more)),
    )


def column_note(label: str) -> str:
    """Explanation of the columns of the fronts."""
    rule = RULES.get(label, f"{label}: the score of the selection, least selected")
    # Candidates scored by trajectories have neither rows nor bootstraps.
    return f"{rule}." if label == "deviance" else f"{rule}. {COLUMNS}"


def _published_summary(run: Evaluation, refitted: Mapping[str, Candidate]) -> dict[str, Any]:
    """Summary of the published terms as fitted to our data."""
    return {
        "equations": {
            name: {
                "terms": run.model.terms(name),
                "r2_test": candidate.r2_test,
                "text": equation_text(name, candidate.coef_by_term),
            }
            for name, candidate in refitted.items()
        },
        "trajectory": facts(run, TRAJECTORY),
    }


def estimate_section(name: str, found: Estimate, data: Trajectory, *, of_model: bool) -> Section:
    """Section on the noise of the samples, the misfit of the model, and other possible supports.

    of_model: False if the estimate's model is not the one that was chosen.
    """
    rows = ResultTable([found], [*noise_sizes(data), *ESTIMATE]).screen(by_state=True)
    blocks: list[Block] = [
        *([] if of_model else [Text(REPLACED, warning=True)]),
        Table(rows, title="noise of the samples", note=NOISE),
        Text(found.misfit or FITS, warning=bool(found.misfit)),
    ]
    if found.too_few_samples:
        blocks.append(Text(found.too_few_samples, warning=True))
    if found.rivals:
        rivals = ResultTable(found.rivals, RIVALS).screen()
        blocks.append(Table(rivals, title="other supports that may be"))
    elif not found.misfit:
        blocks.append(Text("No other support of an equation has odds above 1:1000."))
    return Section(f"{name}: what the samples say", blocks, level=3)


def noise_sizes(data: Trajectory) -> Metrics[Estimate]:
    """The noise in SI, and relative to the state's spread."""

    def size(found: Estimate) -> dict[str, str]:
        sizes = by_state(found, found.noise_std)
        return {s: f"{v:.3g} {data.units[s]}".removesuffix(" 1") for s, v in sizes.items()}

    def share(found: Estimate) -> dict[str, str]:
        shares = {
            s: v / data.columns([s]).std() for s, v in by_state(found, found.noise_std).items()
        }
        return {s: f"{100.0 * share:.2g} %" for s, share in shares.items()}

    return [
        Metric("noise (std)", size, View.SCREEN),
        Metric("of the state's std", share, View.SCREEN),
    ]


def by_state(found: Estimate, values: np.ndarray) -> dict[str, float]:
    """Values of the states that were measured."""
    pairs = zip(found.model.states, np.asarray(values).tolist(), strict=True)
    return dict(compress(pairs, np.isfinite(found.noise_std)))


def odds(value: float) -> str:
    """The odds as text, such as `1:27`; 1:1 is even."""
    return f"1:{1.0 / value:.3g}"


READ = View.JSON | View.SCREEN
RIVALS: Metrics[Rival] = [
    Metric("state", lambda rival: rival.state),
    Metric("equation", lambda rival: f"{rival.state}'", View.SCREEN),
    Metric("terms", lambda rival: list(rival.terms)),
    Metric("terms", lambda rival: ", ".join(t.replace("*", " ") for t in rival.terms), View.SCREEN),
    Metric("odds", lambda rival: rival.odds, View.SHOWN, "odds against the chosen", odds),
]
ESTIMATE: Metrics[Estimate] = [
    Metric("noise_std", lambda found: by_state(found, found.noise_std)),
    Metric("memory", lambda found: by_state(found, found.memory), READ, format="{:.2f}"),
    Metric(
        "noise_growth", lambda found: by_state(found, found.growth), READ, "grows",
        lambda value: f"{100.0 * value:.3g} %",
    ),
    Metric(
        "noise_kurtosis", lambda found: by_state(found, found.kurtosis), READ, "kurtosis",
        lambda value: f"{value:.3g}".replace("nan", ""),
    ),
    Metric("delays_s", lambda found: by_state(found, found.delays_s)),
    Metric("remarks", lambda found: list(found.remarks)),
    Metric("flow_error", lambda found: found.flow_error),
    Metric("misfit", lambda found: found.misfit or None),
    Metric("too_few_samples", lambda found: found.too_few_samples or None),
    Metric("rivals", lambda found: [facts(rival, RIVALS) for rival in found.rivals]),
]  # fmt: skip


def frequencies(data: Trajectory) -> Metrics[Evaluation]:
    """Metrics of models' runs against the data: frequencies by state, trajectory error, verdict."""
    text = data.clock.frequency_text
    f_data = {
        state: dominant_frequency(data.t, column)
        for state, column in zip(data.state_names, data.states.T, strict=True)
    }

    def both(run: Evaluation) -> dict[str, float]:
        pairs = [(f"data_{s}", f"model_{s}", f, run.frequency_Hz[s]) for s, f in f_data.items()]
        return {k: v for data, model, f, own in pairs for k, v in ((data, f), (model, own))}

    return [
        Metric("f", both, View.CSV, column="f_{}_Hz"),
        Metric("f_data", lambda run: f_data, View.SCREEN, "frequency of the data", text),
        Metric("f_model", lambda run: run.frequency_Hz, View.SCREEN, "of the model", text),
        Metric("nrmse", lambda run: run.nrmse, View.SHOWN, format="{:.3f}"),
        Metric("status", lambda run: run.text, View.CSV | View.SCREEN),
    ]


RECORDS: Metrics[tuple[str, str, Evaluation]] = [
    Metric("model", lambda row: row[0], View.SHOWN),
    Metric("record", lambda row: row[1], View.SHOWN),
    Metric("nrmse", lambda row: row[2].nrmse, View.SHOWN, format="{:.3f}"),
    Metric("status", lambda row: row[2].text, View.CSV | View.SCREEN),
]
