"""The balance of a zone next to a model: its processes, and their terms, in record and model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.figures.free_run import balance_figure
from ep2sindy.library.relations import Constraint
from ep2sindy.model.model import SparseModel
from ep2sindy.model.stability import LimitCycle
from ep2sindy.report.report import Report
from ep2sindy.report.results import Metric, Metrics, ResultTable, View
from ep2sindy.studies.processes import IONS, NEUTRALS, ComparedProcess, Zones, compared_processes

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
class ProcessTerm:
    """One term of a process of the model."""

    process: ComparedProcess
    term: str

    @property
    def coef(self) -> float:
        return self.process.coef[self.term]

    @property
    def counterpart(self) -> float:
        """The coefficient by least squares of the recorded process on all of its terms, or NaN."""
        return self.process.counterpart.get(self.term, np.nan)


TERMS: Metrics[ProcessTerm] = [
    Metric("part", lambda each: each.process.name, View.SHOWN, "process"),
    Metric("term", lambda each: each.term, View.SHOWN),
    Metric("coefficient", lambda each: each.coef, View.SHOWN),
    Metric("counterpart", lambda each: each.counterpart, View.SHOWN, "by the record"),
    Metric(
        "ratio", lambda each: each.coef / (each.counterpart or np.nan), View.SHOWN, format="{:.2f}"
    ),
    Metric("fit_r2", lambda each: each.process.fit_r2, View.SHOWN, "its R2", "{:.3f}"),
]


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
    report.table(f"balance_{name}", rows, title=title, note=NOTE)
    known = [each for each in processes if each.recorded is not None]
    if known and cycle is not None:
        shown = data.t - data.t[0] <= 2.0 * cycle.period_s
        parts = {each.name: (each.recorded[shown], each.modelled[shown]) for each in known}  # type: ignore[index]
        draw = partial(balance_figure, data.t[shown], parts, clock=data.clock)
        report.figure(f"balance_{name}", draw, CAPTION)
    terms = [ProcessTerm(each, term) for each in processes for term in each.coef]
    title = "each term by its process"
    report.table(f"terms_{name}", ResultTable(terms, TERMS), title=title, note=COUNTERPARTS)
