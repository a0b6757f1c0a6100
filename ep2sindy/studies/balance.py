"""The balance of a zone next to a model: processes compared, and terms left out in turn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.figures.free_run import balance_figure
from ep2sindy.forecasting.evaluation import Evaluation, evaluate
from ep2sindy.library.relations import Constraint, constraint
from ep2sindy.library.roles import constraint_of
from ep2sindy.model.comparison import FreeRunBounds
from ep2sindy.model.model import SparseModel
from ep2sindy.model.stability import LimitCycle
from ep2sindy.report.report import Report
from ep2sindy.report.results import Metric, Metrics, ResultTable, View
from ep2sindy.runtime.progress import SILENT, Progress, count_pieces
from ep2sindy.studies.processes import (
    IONS,
    NEUTRALS,
    ComparedProcess,
    Zones,
    compared_processes,
    ends_of,
)
from ep2sindy.studies.sustained import start_of, two_periods
from ep2sindy.studies.views import largest

CAPTION = (
    "What zones gain or lose by each process, over two periods: in the record (grey), and by "
    "the model's terms at the record's densities (colour)."
)
NOTE = (
    "Rates are means over the record; the model's are its terms at the record's densities. R2: of "
    "the model's rate against the record's, sample by sample."
)
COUNTERPARTS = (
    "By the record: the coefficients of the same terms by least squares of the recorded process on "
    "them, with its R2 at each instant."
)


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


@dataclass(frozen=True, eq=False)
class TermRole:
    """One term of the model.

    part: what it is a term of: a process in words, or the state whose equation holds it. is_known:
    whether nothing was fitted, so that it is not left out. without: free run of the model refined
    without the process, or without the coefficient in all of its equations; None if it is known or
    cannot be refined. process: of the term, whose counterpart the record may give.
    """

    part: str
    term: str
    coef: float
    is_known: bool
    without: Evaluation | None
    process: ComparedProcess | None = None

    @property
    def counterpart(self) -> float:
        """The coefficient by least squares of the recorded process on all of its terms, or NaN."""
        return np.nan if self.process is None else self.process.counterpart.get(self.term, np.nan)

    @property
    def ratio(self) -> float:
        return self.coef / (self.counterpart or np.nan)

    @property
    def status(self) -> str:
        """What becomes of the model without the term, in words."""
        if self.is_known:
            return "known"
        return self.without.text if self.without else "cannot be refined"


TERMS: Metrics[TermRole] = [
    Metric("part", lambda role: role.part, View.SHOWN, "process or equation of"),
    Metric("term", lambda role: role.term, View.SHOWN),
    Metric("coefficient", lambda role: role.coef, View.SHOWN),
    Metric("counterpart", lambda role: role.counterpart, View.SHOWN, "by the record"),
    Metric("ratio", lambda role: role.ratio, View.SHOWN, format="{:.2f}"),
    Metric("fit_r2", lambda r: r.process and r.process.fit_r2, View.SHOWN, "its R2", "{:.3f}"),
    Metric("without_status", lambda role: role.status, View.SHOWN, "without it"),
    Metric("without_f_error", lambda role: role.without and role.without.f_error),
    Metric(
        "without_waveform_error",
        lambda role: role.without and largest(role.without.waveform_error),
        View.SHOWN, "waveform", "{:.3f}",
    ),
]  # fmt: skip


@dataclass(frozen=True, eq=False)
class ModelBalance:
    """A self-sustained model next to the balance of its zone.

    processes: none if the model was not found under roles of n_i and n_n. terms: each left out in
    turn.
    """

    processes: Sequence[ComparedProcess]
    terms: Sequence[TermRole]


def add_balance(
    report: Report, name: str, found: ModelBalance, data: Trajectory, cycle: LimitCycle | None
) -> None:
    """Add the processes, then one row per term, and the model without it.

    name: of the library. data: samples of the processes. cycle: of the model; without one there is
    no figure.
    """
    report.section(f"{name}: terms as physical processes", level=3)
    if found.processes:
        title = "what is exchanged, in record and model"
        rows = ResultTable(found.processes, PROCESSES)
        report.table(f"balance_{name}", rows, title=title, note=NOTE)
    known = [each for each in found.processes if each.recorded is not None]
    if known and cycle is not None:
        shown = data.t - data.t[0] <= 2.0 * cycle.period_s
        parts = {each.name: (each.recorded[shown], each.modelled[shown]) for each in known}  # type: ignore[index]
        draw = partial(balance_figure, data.t[shown], parts, clock=data.clock)
        report.figure(f"balance_{name}", draw, CAPTION)
    note = COUNTERPARTS if any(np.isfinite(each.counterpart) for each in found.terms) else ""
    title = "each term by its process, and left out" if found.processes else "each term left out"
    report.table(f"terms_{name}", ResultTable(found.terms, TERMS), title=title, note=note)


def model_balance(
    model: SparseModel,
    held_to: Constraint | None,
    data: Trajectory,
    train: Trajectory,
    held: Trajectory,
    zones: Zones,
    bounds: FreeRunBounds,
    *,
    progress: Progress = SILENT,
) -> ModelBalance:
    """Compare a model with the balance of its zone, and leave out each of its terms in turn.

    held_to: what the model's coefficients obey; None if they are free. Models without a term are
    refined on `train` and run over `held`.
    """
    support = {state: list(model.terms(state)) for state in model.states}
    held_to = held_to or constraint(model.library, support)
    processes: list[ComparedProcess] = []
    named = {state.partition("@")[0] for state in model.states}
    if zones.balances and held_to.processes and named == {IONS, NEUTRALS}:
        processes = compared_processes(model, held_to, data, zones)
    lesser, window = _each_left_out(model, held_to, by_process=bool(processes)), two_periods(train)
    left_out: list[Evaluation | None] = []
    for less in count_pieces(progress, lesser, "coefficient", "models without a term"):
        refined, run = _without(model, less, train, window, progress), None
        if refined is not None:
            run = evaluate(refined, held, initial=start_of(held, refined), bounds=bounds)
        left_out.append(run)
    return ModelBalance(processes, _roles(model, held_to, processes, left_out))


def _roles(
    model: SparseModel,
    held_to: Constraint,
    processes: Sequence[ComparedProcess],
    left_out: Sequence[Evaluation | None],
) -> list[TermRole]:
    """The terms of all processes, or of all equations if there are none."""
    if not processes:
        found = []
        for (state, term), follows in zip(held_to.coefficients, held_to.C, strict=True):
            run = left_out[int(follows.argmax())] if follows.any() else None
            coef = model.terms(state).get(term, 0.0)
            found.append(TermRole(state, term, coef, not follows.any(), run))
        return found
    asked = [(ends_of(process), process.term) for process in held_to.processes]
    runs = dict(zip(asked, left_out, strict=True))
    places = [(each, term, (each.ends, term)) for each in processes for term in each.coef]
    return [
        TermRole(each.name, term, each.coef[term], at not in runs, runs.get(at), each)
        for each, term, at in places
    ]


def _without(
    model: SparseModel, less: Constraint, train: Trajectory, window: int | None, progress: Progress
) -> SparseModel | None:
    """The model refined under a constraint with fewer terms; None if it is not finite."""
    from ep2sindy.refinement.refine import refine, with_coef  # loads torch, only for a refinement

    if {state for state, _ in less.coefficients} != set(model.states):
        return None
    values = np.array([model.terms(s).get(term, 0.0) for s, term in less.coefficients])
    start = with_coef(model, less, less.coef(values[less.free]))[0]
    found = refine(
        start, [train], window=window, constraint=less, n_reweights=0, seed=0, progress=progress
    )
    return None if found.status == "non_finite" else found.model


def _each_left_out(
    model: SparseModel, held_to: Constraint, *, by_process: bool
) -> list[Constraint]:
    """The constraint without one process, or without one free coefficient, in turn.

    A coefficient may be the sum of what a state loses by several processes, of which one is left
    out, or be known in part; so it is not put to zero where processes are known.
    """
    if not by_process:
        return [_less(held_to, free) for free in range(len(held_to.free))]
    found = []
    for process in held_to.processes:
        others = [each for each in held_to.processes if each is not process]
        less = constraint_of(model.library, model.states, others, held_to.known)
        assert less is not None, "fewer processes are distinguished as well"
        found.append(less)
    return found


def _less(held_to: Constraint, free: int) -> Constraint:
    """The constraint without one free coefficient, and without those that follow from it alone."""
    C = np.delete(held_to.C, free, axis=1)
    kept = np.flatnonzero(C.any(axis=1) | (held_to.d != 0.0))
    return Constraint(
        held_to.states,
        tuple(held_to.coefficients[k] for k in kept),
        C[kept],
        held_to.d[kept],
        np.searchsorted(kept, np.delete(held_to.free, free)),
    )
