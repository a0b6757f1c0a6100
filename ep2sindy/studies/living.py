"""A closed living model, found by free runs in one part of a record and tested on the rest.

A living model is one that keeps oscillating on its own. The module also holds the section,
tables, figures and summary for the studies that show such a model.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from ep2sindy.data.numbers import zero_to_one
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.discover import discover
from ep2sindy.discovery.method import Regression
from ep2sindy.discovery.result import Discovery
from ep2sindy.figures import living as figures
from ep2sindy.forecasting.evaluation import Evaluation, evaluate
from ep2sindy.library.equations import equation_text
from ep2sindy.library.library import Library, polynomial
from ep2sindy.library.roles import Roles
from ep2sindy.library.units import SECONDS, Clock
from ep2sindy.model.comparison import FreeRunBounds, Status
from ep2sindy.model.display import grouped
from ep2sindy.model.mass_action import consequences
from ep2sindy.model.model import SparseModel
from ep2sindy.model.stability import LimitCycle
from ep2sindy.regression.searches import Search
from ep2sindy.report.document import Block, Captioned, Equation, Section, Table, Text, pictures
from ep2sindy.report.results import Metric, Metrics, ResultTable, View, facts, percent
from ep2sindy.runtime.progress import SILENT, Progress
from ep2sindy.selection.criteria import OtherSystem, Selection
from ep2sindy.signals.attractor import find_cycle, mean_cycle, white_variance
from ep2sindy.signals.smoothers import KalmanSmoother
from ep2sindy.signals.spectrum import power_spectrum, samples_in_periods
from ep2sindy.studies.source import NO_ZONES, TELLING, Zones, told_roles
from ep2sindy.studies.study import Count, Positive
from ep2sindy.studies.views import (
    coefficients,
    display_equation,
    interval_table,
    intervals,
    rollout_tables,
    terms_text,
)

WAVEFORM = "One period by phase, shown twice: samples, their waveform, and the model's."
CAPTIONS = {
    "free_run": "The living model (colour) integrated freely from the first sample of held-out "
    "time, over the data (grey): the first and the last periods.",
    "cycle": "Its cycle in the plane of two states, over the data (grey), and runs from other "
    "starts.",
    "waveform": WAVEFORM,
}
SPREAD = "spread over windows"  # of the coefficients: no knowledge of a rate
SPREAD_NOTE = (
    "Spread over windows: 95 % intervals by how the windows of the refinement differ; they do not "
    "say how far off the model itself is."
)
MOST_OTHERS = 12  # shown on the page
OTHERS_NOTE = (
    "Largest errors over the parts of the record that a model was not fitted to; deviation: the "
    "largest of the three in units of the bounds of a model that lives. All stay within them: what "
    "these models have in common is what the record tells."
)


@dataclass(frozen=True)
class LivingSearch:
    """How a library without inputs is searched for a model that lives.

    depth: number of candidates per size, and equation if there are no roles. roles: of terms, for
    equations that conserve what states exchange; None leaves every term free. degree: of a library
    of the states of its own; None takes the library that the equations were selected from.
    noise_limit: white noise of a state, in standard deviations of its cycle, above which the search
    sees the record's mean cycle (`ep.signals.mean_cycle`); None never does.
    """

    search: Search
    depth: Count
    selection: Selection
    roles: Roles | None = None
    degree: Count | None = None
    noise_limit: Positive | None = None

    def __post_init__(self) -> None:
        if self.selection.basis != "runs":
            raise ValueError(
                "a model lives or not when it runs: selection must be a rule that runs models, "
                f"such as FreeRunScore(), {self.selection!r} came"
            )

    def found(
        self,
        train: Trajectory,
        library: Library,
        rows: Regression,
        zones: Zones = NO_ZONES,
        *,
        rng: np.random.Generator,
        progress: Progress = SILENT,
    ) -> Discovery:
        """The discovery in a record, with the formulation and bootstraps of `rows`.

        zones: their balances tell what the roles take as known, and of several, the roles hold in
        each.
        """
        own = replace(rows, search=self.search, depth=self.depth, selection=self.selection)
        library = polynomial(train.state_names, degree=self.degree) if self.degree else library
        roles, told = self._told(train, zones)
        seen, words = self._quiet(train)
        found = discover(seen, library, own, roles=roles, seed=rng, progress=progress)
        found = replace(found, note=f"{found.note}{told}")
        if not words:
            return found
        # The noise is gone from the samples, and with it what intervals are made of.
        model = replace(found.model, covariance=None)
        return replace(found, model=model, note=f"{words}{found.note}")

    def _told(self, train: Trajectory, zones: Zones) -> tuple[Roles | None, str]:
        """The roles with what the record tells, and how well it tells what is fitted to it."""
        if self.roles is None:
            return None, ""
        roles = self.roles.in_zones(zones.sizes) if zones.sizes else self.roles
        told = told_roles(zones.balances, train)
        fitted = [role for role in roles.open if role in told and role in TELLING]
        known = {name: role.terms for name, role in told.items()}
        words = (
            f"{name} by {', '.join(told[name].terms)} (R2 {told[name].r2:.3f})" for name in fitted
        )
        return roles.with_known(known), f"; told: {', '.join(words)}" if fitted else ""

    def _quiet(self, train: Trajectory) -> tuple[Trajectory, str]:
        """What the search sees of a record, and why, if that is its mean cycle."""
        if self.noise_limit is None or (cycle := find_cycle(train.t, train.states)) is None:
            return train, ""
        white = np.sqrt([white_variance(*power_spectrum(train.t, x)) for x in train.states.T])
        noise = white / zero_to_one(cycle.std)
        if noise.max() <= self.noise_limit:
            return train, ""
        worst = train.state_names[int(noise.argmax())]
        return mean_cycle(train), (
            f"found in the mean cycle, without intervals, since the white noise of {worst} is "
            f"{noise.max():.2g} times its variation; "
        )

    @property
    def bounds(self) -> FreeRunBounds:
        """The bounds by which the selection rule calls a model living."""
        from ep2sindy.selection.free_run import FreeRunScore  # loads torch, only for a search

        rule = self.selection
        return rule.bounds if isinstance(rule, FreeRunScore) else FreeRunBounds()


@dataclass(frozen=True, eq=False)
class Refined:
    """A refinement of the model selected by derivatives: its status and its free run."""

    status: str
    run: Evaluation


@dataclass(frozen=True, eq=False)
class Living:
    """A closed model and its run over the held-out part.

    run: it starts at the first held-out sample, smoothed by a Kalman smoother so that the sample's
    noise is not attributed to the model. by_derivatives: the equations selected by their
    derivatives, refined with the same terms.
    """

    discovery: Discovery
    held: Trajectory
    run: Evaluation
    by_derivatives: Refined

    @property
    def cycle(self) -> LimitCycle | None:
        return self.run.cycle

    @property
    def model(self) -> SparseModel:
        return self.discovery.model

    @property
    def n_terms(self) -> int:
        return int(np.count_nonzero(self.model.coef))

    def equations(self, clock: Clock = SECONDS) -> list[Equation]:
        """By process, if they were found under roles."""
        held = self.discovery.constraint
        return [display_equation(self.model, s, clock, held=held) for s in self.model.states]

    def section(self, name: str) -> Section:
        """Equations with intervals, how they run, and the behaviour of the derivatives' choice."""
        model, clock = self.model, self.run.rollout.clock
        rows = ResultTable([self], LIVING).screen(by_state=True)
        blocks: list[Block] = [
            *self.equations(clock),
            *interval_table(model, clock=clock, words=SPREAD, note=SPREAD_NOTE),
            Table(rows, title=run_title(self.run)),
            *(Text(text) for text in (_note(self), _by_derivatives(self))),
            *pictures(self.figures(name)),
            *self._others(),
        ]
        lives = self.run.status is Status.SUSTAINED
        ending = "lives" if lives else f"does not live ({self.run.text})"
        return Section(f"{name}: a model that {ending}", blocks)

    def _others(self) -> list[Block]:
        """The other systems of this size that live: whether the found one is the law."""
        others = self.discovery.others
        if not others:
            return []
        table = ResultTable(others[:MOST_OTHERS], OTHERS).screen()
        more = f"; the first {MOST_OTHERS} of {len(others)}" if len(others) > MOST_OTHERS else ""
        title = f"other models of as many coefficients that live where not fitted{more}"
        return [Table(table, title=title, note=OTHERS_NOTE, page_only=True)]

    def figures(self, name: str) -> dict[str, Captioned]:
        """Figures by name; those of a cycle only if there is one."""
        run, held = self.run, self.held
        drawn: dict[str, Any] = {}
        if self.cycle is not None:
            period_s = self.cycle.period_s
            drawn["free_run"] = partial(
                figures.free_run_figure, held, run.rollout, period_s=period_s
            )
            if len(self.model.states) > 1:
                drawn["cycle"] = partial(figures.cycle_figure, held, self.cycle)
            if figures.find_waveforms(held, run.rollout):
                drawn["waveform"] = partial(figures.waveform_figure, held, run.rollout)
        return {f"{key}_{name}": Captioned(draw, CAPTIONS[key]) for key, draw in drawn.items()}

    def summary(self) -> dict[str, Any]:
        """The entry in `summary.json`."""
        return facts(self, LIVING)


LIVING: Metrics[Living] = [
    Metric("terms", lambda found: _terms(found.model), View.JSON),
    Metric("n_terms", lambda found: found.n_terms),
    Metric("status", lambda found: str(found.run.status)),
    Metric(
        "frequency",
        lambda found: found.run.rollout.clock.frequency_text(
            found.run.frequency_Hz[found.model.states[0]]
        ),
        View.SCREEN,
    ),
    Metric("f_error", lambda found: found.run.f_error, View.ALL, "its error", percent(2)),
    Metric(
        "amplitude_ratio",
        lambda found: found.run.amplitude_ratio,
        View.SHOWN,
        "amplitude (times the data's)",
        "{:.3f}",
    ),
    Metric("waveform_error", lambda found: found.run.waveform_error, View.SHOWN, format="{:.3f}"),
    Metric("waveform_error", lambda found: max(found.run.waveform_error.values()), View.HEADLINE),
    Metric("status", lambda found: found.run.text, View.SCREEN),
    Metric("periods", lambda found: found.run.periods),
    Metric("floquet", lambda found: found.cycle and _multipliers(found.cycle), View.JSON),
    Metric("stability", lambda found: found.cycle and found.cycle.stability),
    Metric("share_reaching", lambda found: found.run.share_reaching),
    Metric("rest", lambda found: _rest(found), View.JSON),
    Metric("refinement_by_derivatives", lambda found: found.by_derivatives.status, View.CSV),
    Metric("status_by_derivatives", lambda found: str(found.by_derivatives.run.status), View.CSV),
    Metric("coefficients", lambda found: _with_intervals(found.model), View.JSON),
    Metric("text", lambda found: _text(found), View.JSON),
    Metric("proved", lambda found: consequences(found.model), View.JSON),
    Metric("selection", lambda found: found.discovery.note, View.JSON),
    Metric(
        "others", lambda found: [facts(each, OTHERS) for each in found.discovery.others], View.JSON
    ),
    Metric("by_derivatives", lambda found: facts(found.by_derivatives, REFINED), View.JSON),
]
OTHERS: Metrics[OtherSystem] = [
    Metric("terms", lambda each: terms_text(each.terms), View.SHOWN),
    Metric("f_error", lambda each: each.f_error, View.SHOWN, "frequency", percent(2)),
    Metric("amplitude_error", lambda each: each.amplitude, View.SHOWN, "amplitude", percent(1)),
    Metric("waveform_error", lambda each: each.waveform, View.SHOWN, "waveform", "{:.3f}"),
    Metric("deviation", lambda each: each.deviation, View.SHOWN, format="{:.2f}"),
]
REFINED: Metrics[Refined] = [
    Metric("refinement", lambda refined: refined.status),
    Metric("status", lambda refined: str(refined.run.status)),
    Metric("text", lambda refined: refined.run.model.text()),
]


def living_tables(living: Mapping[str, Living]) -> dict[str, pd.DataFrame]:
    if not living:
        return {}
    found = {"living": ResultTable(living, LIVING).csv("library")}
    for name, each in living.items():
        if each.discovery.others:
            found[f"living_others_{name}"] = ResultTable(each.discovery.others, OTHERS).csv()
        found |= rollout_tables(each.held, {f"{name}_living": each.run})
    models = {name: each.model for name, each in living.items()}
    return found | {"coefficients_living": coefficients(models, heading="library")}


def _text(living: Living) -> str:
    """The equations in SI, as they are printed."""
    sums = grouped(living.model, living.discovery.constraint)
    return "\n".join(equation_text(state, terms) for state, terms in sums.items())


def _terms(model: SparseModel) -> dict[str, list[str]]:
    return {state: list(model.terms(state)) for state in model.states}


def _rest(living: Living) -> dict[str, Any] | None:
    rest = living.run.rest
    if rest is None:
        return None
    state = dict(zip(living.model.states, rest.state.tolist(), strict=True))
    return {"state": state, "growth_per_s": rest.growth_per_s, "frequency_Hz": rest.frequency_Hz}


def _multipliers(cycle: LimitCycle) -> list[list[float]]:
    return [[float(m.real), float(m.imag)] for m in cycle.multipliers]


def _with_intervals(model: SparseModel) -> dict[str, dict[str, Any]]:
    known = intervals(model)
    return {
        state: {
            term: {
                "value": value,
                SPREAD.replace(" ", "_"): None if known is None else known[state][term],
            }
            for term, value in model.terms(state).items()
        }
        for state in model.states
    }


def run_title(run: Evaluation) -> str:
    """The title of the table of a run, with how long it is in phase if the record has a period."""
    in_phase = "" if np.isnan(run.periods) else f"; in phase for {round(run.periods)} periods"
    return f"run freely from one sample over held-out time{in_phase}"


def _note(living: Living) -> str:
    """Note on the selection, the stability, and the columns of the table."""
    proved = consequences(living.model)
    found = [f"By its terms {'; '.join(proved)}."] if proved else []
    found.append(f"Selection: {living.discovery.note}.")
    found += [living.run.cycle_text] if living.run.cycle_text else []
    found += [f"Misfit: {living.discovery.misfit}."] if living.discovery.misfit else []
    found.append(
        "Amplitude: ratio of standard deviations; waveform error: RMS difference in standard "
        "deviations of the data."
    )
    return " ".join(found)


def _by_derivatives(living: Living) -> str:
    """Text on the equations selected by derivatives, after their refinement."""
    refined = living.by_derivatives
    text = "; ".join(
        equation_text(state, refined.run.model.terms(state)) for state in refined.run.model.states
    )
    if refined.status == "non_finite":
        return (
            "The equations selected by their derivatives cannot be refined: no trajectory of "
            f"theirs stays finite over two periods ({text})."
        )
    return (
        f"The equations selected by their derivatives, refined as they are ({refined.status}): "
        f"{refined.run.text} ({text})."
    )


def living_model(
    train: Trajectory,
    held: Trajectory,
    library: Library,
    rows: Regression,
    settings: LivingSearch,
    selected: SparseModel,
    zones: Zones,
    *,
    rng: np.random.Generator,
    progress: Progress = SILENT,
) -> Living:
    """Find a living model in one part of a record, and run it over the other.

    selected: the model selected by derivatives, which is refined for comparison.
    """
    found = settings.found(train, library, rows, zones, rng=rng, progress=progress)
    run = evaluate(found, held, initial=start_of(held, found.model), bounds=settings.bounds)
    return Living(found, held, run, _refined(selected, train, held, progress))


def start_of(run: Trajectory, model: SparseModel) -> np.ndarray:
    """The first sample of a record, smoothed."""
    first = run.window(0, min(run.n_samples, 200))
    smoothed: np.ndarray = KalmanSmoother().smooth(first.t, first.columns(model.states))
    return smoothed[0]


def two_periods(run: Trajectory) -> int | None:
    """Samples in two periods; None if there is no period, or no room for two such windows."""
    cycle = find_cycle(run.t, run.states)
    if cycle is None or cycle.n_periods < 4.0:
        return None
    return samples_in_periods(2.0, frequency_Hz=cycle.frequency_Hz, dt_s=run.dt_s)


def _refined(
    model: SparseModel, train: Trajectory, held: Trajectory, progress: Progress
) -> Refined:
    """Refine a model on windows of two periods, if the data have a period."""
    from ep2sindy.refinement.refine import refine  # loads torch, only for a refinement

    found = refine(model, [train], window=two_periods(train), seed=0, progress=progress)
    return Refined(found.status, evaluate(found.model, held, initial=start_of(held, model)))
