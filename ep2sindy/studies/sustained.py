"""A closed self-sustained model, found by free runs in one part of a record and tested on the rest.

A self-sustained model is one that keeps oscillating on its own. The module also holds its section
of a report, and the processes of its terms next to those that the record gives.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pandas as pd

from ep2sindy.data.numbers import zero_to_one
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.discover import discover
from ep2sindy.discovery.method import Regression
from ep2sindy.discovery.result import Discovery
from ep2sindy.figures.series import balance_figure, cycle_figure, free_run_figure
from ep2sindy.forecasting.evaluation import Evaluation
from ep2sindy.forecasting.skill import ForecastSkill
from ep2sindy.library.library import Library, polynomial
from ep2sindy.library.relations import Constraint
from ep2sindy.library.roles import Roles
from ep2sindy.model.comparison import FreeRunBounds
from ep2sindy.model.mass_action import consequences
from ep2sindy.model.model import SparseModel
from ep2sindy.model.stability import LimitCycle
from ep2sindy.regression.searches import Search
from ep2sindy.report.report import Report
from ep2sindy.report.results import Metric, Metrics, ResultTable, View
from ep2sindy.runtime.progress import SILENT, Progress
from ep2sindy.selection.criteria import Selection
from ep2sindy.signals.attractor import find_cycle, mean_cycle, white_variance
from ep2sindy.signals.smoothers import KalmanSmoother
from ep2sindy.signals.spectrum import power_spectrum
from ep2sindy.studies.processes import (
    IONS,
    NEUTRALS,
    NO_ZONES,
    TELLING,
    ComparedProcess,
    Zones,
    compared_processes,
    fit_roles,
)
from ep2sindy.studies.study import Count, Positive
from ep2sindy.studies.views import CYCLE, add_samples

CAPTIONS = {
    "free_run": "The model (colour) integrated freely from the first sample of held-out "
    "time, over the data (grey): the first and the last periods.",
    "cycle": "Its cycle in the plane of two states, over the data (grey), and runs from other "
    "starts.",
    "balance": "What zones gain or lose by each process, over two periods: in the record (grey), "
    "and by the model's terms at the record's densities (colour).",
}
SPREAD = "spread over windows"  # of the coefficients: no knowledge of a rate
SPREAD_NOTE = (
    "Spread over windows: 95 % intervals by how the windows of the refinement differ; they do not "
    "say how far off the model itself is."
)


BALANCE_NOTE = (
    "Rates are means over the record; the model's are its terms at the record's densities. R2: of "
    "the model's rate against the record's, sample by sample."
)
COUNTERPARTS = (
    "Counterpart: the coefficients of the same terms by least squares of the recorded process on "
    "them, with the R2 of that fit at each instant; ratio: the model's over the record's."
)


@dataclass(frozen=True)
class SustainedSearch:
    """How a library without inputs is searched for a self-sustained model.

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
                "whether a model sustains its oscillation shows when it runs: selection must be a "
                f"rule that runs models, such as FreeRunScore(), got {self.selection!r}"
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
        roles, about = self._roles_of(train, zones)
        seen, words = self._quiet(train)
        found = discover(seen, library.with_roles(roles), own, seed=rng, progress=progress)
        found = replace(found, note=f"{found.note}{about}")
        if not words:
            return found
        # The noise is gone from the samples, and with it what intervals are made of.
        model = replace(found.model, covariance=None)
        return replace(found, model=model, note=f"{words}{found.note}")

    def _roles_of(self, train: Trajectory, zones: Zones) -> tuple[Roles | None, str]:
        """The roles with what the record tells, and how well it tells what is fitted to it."""
        if self.roles is None:
            return None, ""
        roles = self.roles.in_zones(zones.sizes) if zones.sizes else self.roles
        rates = fit_roles(zones.balances, train)
        fitted = [role for role in roles.open if role in rates and role in TELLING]
        known = {name: role.terms for name, role in rates.items()}
        words = (
            f"{name} by {', '.join(rates[name].terms)} (R2 {rates[name].r2:.3f})" for name in fitted
        )
        return roles.with_known(
            known
        ), f"; fitted to the record: {', '.join(words)}" if fitted else ""

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
        """The bounds by which the selection rule calls a model sustained, or the usual ones."""
        return getattr(self.selection, "bounds", None) or FreeRunBounds()


@dataclass(frozen=True, eq=False)
class SustainedModel:
    """A closed model that was searched for by free runs, and its run over the held-out part.

    run: starts at the first held-out sample, smoothed by a Kalman smoother so that the sample's
    noise is not attributed to the model.
    """

    discovery: Discovery
    run: Evaluation

    @property
    def model(self) -> SparseModel:
        return self.discovery.model

    def forecasting(self, skill: ForecastSkill | None) -> SustainedModel:
        """The same, with the skill of its forecasts."""
        return replace(self, run=replace(self.run, forecasts=lambda: skill))


SUSTAINED_MODEL: Metrics[SustainedModel] = [
    Metric("n_terms", lambda found: int(np.count_nonzero(found.model.coef))),
    *(metric.of(lambda found: found.run) for metric in CYCLE),
    Metric("proved", lambda found: "; ".join(consequences(found.model))),
    Metric("selection", lambda found: found.discovery.note),
    Metric("lack_of_fit", lambda found: found.discovery.lack_of_fit),
]


def add_sustained(report: Report, name: str, found: SustainedModel) -> None:
    """Add the model and how it runs; name: of the library."""
    model, clock, run = found.model, found.run.rollout.clock, found.run
    held_to = found.discovery.constraint
    report.section(f"{name}: the model that free runs select ({run.text})")
    file = f"{name}_sustained"
    report.model(file, model, clock=clock, held=held_to, words=SPREAD, note=SPREAD_NOTE)
    if run.cycle is not None:
        period_s = run.cycle.period_s
        draw = partial(free_run_figure, run.record, run.rollout, period_s=period_s)
        report.figure(f"free_run_{name}", draw, CAPTIONS["free_run"])
    report.add(_notes(found))
    add_cycle(report, name, run)
    add_samples(report, run.record, {file: run})


def add_cycle(report: Report, name: str, run: Evaluation) -> None:
    """Add the figure of the cycle of a model, if it has one. name: of the model."""
    if run.cycle is not None and len(run.model.states) > 1:
        draw = partial(cycle_figure, run.record, run.cycle)
        report.figure(f"cycle_{name}", draw, CAPTIONS["cycle"])


def _notes(found: SustainedModel) -> str:
    """On the selection, the stability, and the lack of fit."""
    proved = consequences(found.model)
    notes = [f"By its terms {'; '.join(proved)}."] if proved else []
    notes.append(f"Selection: {found.discovery.note}.")
    notes += [found.run.cycle_text] if found.run.cycle_text else []
    notes += [f"Lack of fit: {found.discovery.lack_of_fit}."] if found.discovery.lack_of_fit else []
    return " ".join(notes)


def start_of(run: Trajectory, model: SparseModel) -> np.ndarray:
    """The first sample of a record, smoothed."""
    first = run.window(0, min(run.n_samples, 200))
    smoothed: np.ndarray = KalmanSmoother().smooth(first.t, first.columns(model.states))
    return smoothed[0]


PROCESSES: Metrics[ComparedProcess] = [
    Metric("process", lambda each: each.name, View.SHOWN),
    Metric(
        "recorded",
        lambda each: np.nan if each.recorded is None else float(each.recorded.mean()),
        View.SHOWN, "in the record (m^-3/s)",
    ),
    Metric(
        "modelled", lambda each: float(each.modelled.mean()), View.SHOWN, "in the model (m^-3/s)"
    ),
    Metric("ratio", lambda each: each.ratio, View.SHOWN, format="{:.2f}"),
    Metric("r2", lambda each: each.r2, View.SHOWN, "R2", format="{:.3f}"),
    Metric("terms", lambda each: ", ".join(each.coef), View.SHOWN),
]  # fmt: skip


def process_terms(processes: Sequence[ComparedProcess]) -> pd.DataFrame:
    """One row per process and term: its coefficient in the model and by the record."""
    rows = []
    for each in processes:
        for term, coef in each.coef.items():
            recorded = each.counterpart.get(term, np.nan)
            ratio = coef / (recorded or np.nan)
            rows.append((each.name, term, coef, recorded, ratio, each.fit_r2))
    columns = ["part", "term", "coefficient", "counterpart", "ratio", "fit_r2"]
    return pd.DataFrame(rows, columns=columns)


def model_balance(
    model: SparseModel, held_to: Constraint | None, data: Trajectory, zones: Zones
) -> list[ComparedProcess]:
    """The processes of a model next to those of its zone.

    held_to: what the model's coefficients obey; None if they are free. There are none unless the
    model was found under roles of n_i and n_n, and the record gives a balance.
    """
    named = {state.partition("@")[0] for state in model.states}
    if held_to is None or not held_to.processes or not zones.balances or named != {IONS, NEUTRALS}:
        return []
    return compared_processes(model, held_to, data, zones)


def add_balance(
    report: Report,
    name: str,
    processes: Sequence[ComparedProcess],
    data: Trajectory,
    cycle: LimitCycle | None,
) -> None:
    """Add the processes, and one row per term.

    name: of the library. data: samples of the processes. cycle: of the model; without one there is
    no figure.
    """
    report.section(f"{name}: terms as physical processes", level=3)
    title = "what is exchanged, in record and model"
    rows = ResultTable(processes, PROCESSES)
    report.table(f"balance_{name}", rows, title=title, note=BALANCE_NOTE)
    known = [each for each in processes if each.recorded is not None]
    if known and cycle is not None:
        shown = data.t - data.t[0] <= 2.0 * cycle.period_s
        parts = {each.name: (each.recorded[shown], each.modelled[shown]) for each in known}  # type: ignore[index]
        draw = partial(balance_figure, data.t[shown], parts, clock=data.clock)
        report.figure(f"balance_{name}", draw, CAPTIONS["balance"])
    terms, title = process_terms(processes), "each term by its process"
    report.table(f"terms_{name}", terms, title=title, note=COUNTERPARTS)
