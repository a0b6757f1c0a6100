"""The balance of a zone beside a living model: processes compared, and terms left out in turn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from jaxtyping import Float

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.figures.living import balance_figure
from ep2sindy.library.names import split_factors
from ep2sindy.library.relations import Constraint, Process, constraint
from ep2sindy.library.roles import process_values
from ep2sindy.model.comparison import FreeRunBounds
from ep2sindy.model.free_run import FreeRun, free_run
from ep2sindy.model.model import SparseModel
from ep2sindy.model.scores import r2
from ep2sindy.report.document import Block, Captioned, Section, Table, Text, pictures
from ep2sindy.report.results import Metric, Metrics, ResultTable, View, facts
from ep2sindy.runtime.progress import SILENT, Progress, count_pieces
from ep2sindy.studies.living import start_of, two_periods
from ep2sindy.studies.told import IONS, NEUTRALS, recorded_rates

NO_SIZES: Mapping[str, float] = MappingProxyType({})
CAPTION = (
    "What zones gain or lose by each process, over two periods: in the record (grey), and by "
    "the model's terms at the record's densities (colour)."
)
NOTE = (
    "Rates are means over the record; the model's are its terms at the record's densities. R2: of "
    "the model's rate against the record's, sample by sample."
)
# Term's equation, its kind and sign -> terms of the zone's balance, and what they are.
PLACES: Mapping[tuple[str, str, bool], tuple[tuple[str, ...], str]] = {
    (IONS, "mixed", True): (("ionization",), "ionization"),
    (IONS, "neutrals", True): (("ionization",), "ionization"),
    (IONS, "ions", True): (("ionization",), "ionization"),
    (IONS, "ions", False): (("exit_i", "returned"), "exit, walls and anode"),
    (NEUTRALS, "mixed", False): (("ionization",), "ionization"),
    (NEUTRALS, "ions", False): (("ionization",), "ionization"),
    (NEUTRALS, "ions", True): (("returned",), "back from walls and anode"),
    (NEUTRALS, "neutrals", False): (("exit_n",), "exit"),
    (NEUTRALS, "constant", True): (("supply",), "mass flow"),
}


@dataclass(frozen=True, eq=False)
class ComparedProcess:
    """A process of the zone: in the record and by the model's terms, in m^-3/s at every sample.

    recorded: None if the record does not give it. terms: of the model, as `n_i': n_i^2`.
    """

    name: str
    recorded: Float[np.ndarray, " samples"] | None
    modelled: Float[np.ndarray, " samples"]
    terms: Sequence[str]

    @property
    def ratio(self) -> float:
        """Mean rate of the model over that of the record; NaN if the record does not give it."""
        if self.recorded is None:
            return float("nan")
        return float(self.modelled.mean() / self.recorded.mean())

    @property
    def r2(self) -> float:
        """R2 at each instant; NaN for a rate that is constant or not recorded."""
        if self.recorded is None or np.ptp(self.recorded) <= 1e-6 * np.abs(self.recorded).max():
            return float("nan")
        return float(r2(truth=self.recorded, prediction=self.modelled[None])[0])


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
    Metric("terms", lambda each: "; ".join(each.terms), View.SHOWN),
]  # fmt: skip


def compared_processes(
    model: SparseModel, data: Trajectory, balance: xr.Dataset
) -> list[ComparedProcess]:
    """The processes of ions and neutrals, in the record and in a model of n_i and n_n alone.

    What the terms of one equation take away, the other gains: a term of neutrals, or of both, moves
    as much from neutrals to ions as it gives the ions; a term of ions alone as much back as it
    gives the neutrals. The rest leaves. If the two equations do not agree on what they exchange,
    both views of it are compared.
    """
    theta = model.library.evaluate(data.columns(model.library.variables))
    rates: dict[str, dict[str, np.ndarray]] = {}
    for state in (IONS, NEUTRALS):
        rates[state] = {
            term: coef * theta[:, model.library.index(term)]
            for term, coef in model.terms(state).items()
        }
    mixed, ions, neutrals = (partial(_part, rates, kind=k) for k in ("mixed", "ions", "neutrals"))
    back, ahead = ions(NEUTRALS), neutrals(IONS)
    seen = {IONS: (1.0, mixed(IONS)), NEUTRALS: (-1.0, mixed(NEUTRALS))}
    given = {s: sign * _sum(part, len(theta)) for s, (sign, part) in seen.items()}
    shared = _sum(ahead, len(theta)) - _sum(back, len(theta))
    agree = np.allclose(given[IONS], given[NEUTRALS], rtol=1e-6)
    known = recorded_rates(balance, data)
    exchanged = _difference(known, "ionization", "returned")
    words = "neutrals that become ions, less those that walls and anode give back"
    found = []
    for state in (IONS,) if agree else (IONS, NEUTRALS):
        name = words if agree else f"{words}, in {state}'"
        terms = [*_named(state, seen[state][1]), *_named(IONS, ahead), *_named(NEUTRALS, back)]
        found.append(ComparedProcess(name, exchanged, given[state] + shared, terms))
    for state, own, other, key in (
        (IONS, ions, back, "exit_i"), (NEUTRALS, neutrals, ahead, "exit_n"),
    ):  # fmt: skip
        leaving = -_sum(own(state), len(theta)) - _sum(other, len(theta))
        words = "ions that leave" if state == IONS else "neutrals that leave"
        terms = [*_named(state, _less_of(own(state), other))]
        found.append(ComparedProcess(words, known.get(key), leaving, terms))
    supply = _sum(_part(rates, NEUTRALS, kind="constant"), len(theta))
    inflow = ComparedProcess(
        "neutrals that enter", known.get("supply"), supply, [f"{NEUTRALS}': 1"]
    )
    return [each for each in (inflow, *found) if each.modelled.any() or each.recorded is not None]


def zone_processes(
    model: SparseModel,
    held_to: Constraint,
    data: Trajectory,
    balances: Mapping[str, xr.Dataset],
    sizes: Mapping[str, float],
) -> list[ComparedProcess]:
    """The processes of ions and neutrals in and between several zones, in record and model.

    held_to: the model's constraint, from a search under `Roles.in_zones`. balances: by zone.
    sizes: zone -> its length. Rates are those of the zone that gives, or takes from outside.
    """
    theta = model.library.evaluate(data.columns(model.library.variables))
    coef = np.array([model.terms(s).get(term, 0.0) for s, term in held_to.coefficients])
    values = process_values(held_to, coef)
    rates: dict[tuple[str, str], dict[str, np.ndarray]] = {}
    for process, value in zip(held_to.processes, values, strict=True):
        column = theta[:, model.library.index(process.term)]
        rates.setdefault(_ends(process), {})[process.term] = value * column
    for (state, term), value in zip(held_to.coefficients, held_to.d, strict=True):
        if term == "1" and value:
            rates.setdefault(("", state), {})["1"] = np.full(len(theta), value)
    known = {zone: recorded_rates(balance, data) for zone, balance in balances.items()}
    gone = _through_ends(known, sizes)
    found = []
    for ends, terms in rates.items():
        recorded = _zone_rate(*ends, known, gone)
        modelled = _sum(terms, len(theta))
        found.append(ComparedProcess(_zone_words(*ends), recorded, modelled, list(terms)))
    return found


def _ends(process: Process) -> tuple[str, str]:
    """The state that a process takes from, and the one that it gives to; "" is the outside."""
    giver, taker = (
        next((state for (state, _), f in process.factors.items() if sign * f > 0.0), "")
        for sign in (-1.0, 1.0)
    )
    return giver, taker


def _through_ends(
    known: Mapping[str, Mapping[str, np.ndarray]], sizes: Mapping[str, float]
) -> dict[tuple[str, str], np.ndarray]:
    """(state, zone) -> what passes the far end of each zone, by the zone's length, in m^-3/s."""
    found = {}
    for state, key in ((IONS, "exit_i"), (NEUTRALS, "exit_n")):
        passed: Any = 0.0
        for zone, size in sizes.items():
            if key not in known[zone]:
                break
            passed = passed + size * known[zone][key]
            found[state, zone] = passed / size
    return found


def _zone_words(giver: str, taker: str) -> str:
    (state, _, zone), (other, _, beyond) = giver.partition("@"), taker.partition("@")
    names = {IONS: "ions", NEUTRALS: "neutrals"}
    if not giver:
        return f"{names[other]} that enter"
    if not taker:
        return f"{names[state]} that leave"
    if zone != beyond:
        return f"{names[state]} from {zone} to {beyond}"
    return f"{zone}: {names[state]} that become {names[other]}, less those given back"


def _zone_rate(
    giver: str,
    taker: str,
    known: Mapping[str, Mapping[str, np.ndarray]],
    gone: Mapping[tuple[str, str], np.ndarray],
) -> np.ndarray | None:
    """The rate of a process in the record; None if it does not give it."""
    (state, _, zone), (_, _, beyond) = giver.partition("@"), taker.partition("@")
    if not giver:
        return known[beyond].get("supply")
    if zone != beyond:  # to the next zone, or to the outside
        return gone.get((state, zone))
    exchanged = _difference(known[zone], "ionization", "returned")
    return exchanged if state == NEUTRALS or exchanged is None else -exchanged


def _less_of(
    own: Mapping[str, np.ndarray], other: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """The terms that take away more than the other equation gains by them."""
    return {
        term: rate
        for term, rate in own.items()
        if term not in other or not np.allclose(rate, -other[term], rtol=1e-6)
    }


def _kind(term: str) -> str:
    """Which densities a term holds: both, that of ions or of neutrals alone, or none."""
    if term == "1":
        return "constant"
    names = {name for name, _ in split_factors(term)}
    return "mixed" if len(names) > 1 else "ions" if names == {IONS} else "neutrals"


def _part(
    rates: Mapping[str, Mapping[str, np.ndarray]], state: str, *, kind: str
) -> dict[str, np.ndarray]:
    return {term: rate for term, rate in rates[state].items() if _kind(term) == kind}


def _sum(part: Mapping[str, np.ndarray], n: int) -> np.ndarray:
    return np.sum([*part.values(), np.zeros(n)], axis=0)


def _named(state: str, part: Mapping[str, np.ndarray]) -> list[str]:
    return [f"{state}': {term}" for term in part]


def _difference(known: Mapping[str, np.ndarray], first: str, second: str) -> np.ndarray | None:
    return known[first] - known[second] if {first, second} <= set(known) else None


@dataclass(frozen=True, eq=False)
class TermRole:
    """One term of the model.

    process: what the term stands for in the balance; empty if the balance has no such term. alone:
    the coefficient with which it would exchange as much as the record, if it did so alone; NaN if
    the record does not say. without: free run of the model refined without the term, and without
    those that share its coefficient; None if it cannot be refined.
    """

    state: str
    term: str
    coef: float
    process: str
    alone: float
    without: FreeRun | None


# Metrics of a refined model without one term; None if it cannot be refined.
WITHOUT: Metrics[FreeRun | None] = [
    Metric(
        "verdict", lambda run: run.text if run else "cannot be refined", View.SHOWN, "without it"
    ),
    Metric("f_error", lambda run: run.f_error if run else np.nan),
    Metric(
        "waveform_error",
        lambda run: max(run.waveform_error.values()) if run else np.nan,
        View.SHOWN, "waveform", "{:.3f}",
    ),
]  # fmt: skip
ROLES: Metrics[TermRole] = [
    Metric("state", lambda role: role.state),
    Metric("equation", lambda role: f"{role.state}'", View.SCREEN),
    Metric("term", lambda role: role.term, View.SHOWN),
    Metric("coefficient", lambda role: role.coef, View.SHOWN),
    Metric("process", lambda role: role.process, View.SHOWN),
    Metric("alone", lambda role: role.alone, View.SHOWN, "if alone"),
    *(metric.of(lambda role: role.without, "without_{}") for metric in WITHOUT),
]


@dataclass(frozen=True, eq=False)
class ModelBalance:
    """A living model beside the balance of its zone.

    processes: none if the model is not of products of n_i and n_n. terms: each left out in turn.
    """

    processes: Sequence[ComparedProcess]
    terms: Sequence[TermRole]
    data: Trajectory = field(repr=False)
    period_s: float | None = None

    def tables(self, name: str) -> dict[str, pd.DataFrame]:
        found = {f"terms_{name}": ResultTable(self.terms, ROLES).csv()}
        if self.processes:
            found[f"balance_{name}"] = ResultTable(self.processes, PROCESSES).csv()
        return found

    def figures(self, name: str) -> dict[str, Captioned]:
        rows = [each for each in self.processes if each.recorded is not None]
        if not rows or self.period_s is None:
            return {}
        shown = self.data.t - self.data.t[0] <= 2.0 * self.period_s
        parts = {each.name: (each.recorded[shown], each.modelled[shown]) for each in rows}  # type: ignore[index]
        draw = partial(balance_figure, self.data.t[shown], parts, clock=self.data.clock)
        return {f"balance_{name}": Captioned(draw, CAPTION)}

    def section(self, name: str) -> Section:
        """The processes, then one row per term, and the model without it."""
        blocks: list[Block] = []
        if self.processes:
            rows = ResultTable(self.processes, PROCESSES).screen()
            blocks.append(Table(rows, title="what is exchanged, in record and model", note=NOTE))
        rows = ResultTable(self.terms, ROLES).screen()
        blocks.append(Table(rows, title="each term by its process, and left out"))
        if any(np.isfinite(each.alone) for each in self.terms):
            blocks.append(Text(
                "If alone: the coefficient with which the term would exchange as much as the "
                "record, in the mean, if no other term did."
            ))  # fmt: skip
        return Section(
            f"{name}: what the terms mean", [*blocks, *pictures(self.figures(name))], level=3
        )

    def summary(self) -> dict[str, Any]:
        """The entry in `summary.json`."""
        return {
            "processes": [facts(each, PROCESSES) for each in self.processes],
            "terms": [facts(role, ROLES) for role in self.terms],
        }


def model_balance(
    model: SparseModel,
    held_to: Constraint | None,
    data: Trajectory,
    train: Trajectory,
    held: Trajectory,
    balances: Mapping[str, xr.Dataset],
    bounds: FreeRunBounds,
    *,
    sizes: Mapping[str, float] = NO_SIZES,
    period_s: float | None,
    progress: Progress = SILENT,
) -> ModelBalance:
    """Compare a model with the balance of its zone, and leave out each of its terms in turn.

    held_to: what the model's coefficients obey; None if they are free. Models without a term are
    refined on `train` and run over `held`. balances: of the zones, by `zone_balance`; a single one
    is called "". sizes: length of each of several zones. period_s: of the model's cycle, for the
    figure.
    """
    balance = balances.get("")
    support = {state: list(model.terms(state)) for state in model.states}
    held_to = held_to or constraint(model.library, support)
    ours = balance is not None and set(model.states) == set(model.library.variables)
    ours = ours and set(model.states) == {IONS, NEUTRALS} and not model.library.functions
    known = recorded_rates(balance, data) if ours and balance is not None else {}
    processes = compared_processes(model, data, balance) if ours and balance is not None else []
    if sizes and balances and held_to is not None and held_to.processes:
        processes = zone_processes(model, held_to, data, balances, sizes)
    window, left_out = two_periods(train), {}
    free = range(len(held_to.free))
    for k in count_pieces(progress, free, "coefficient", "models without a term"):
        left_out[k] = _without(model, held_to, k, train, held, bounds, progress, window=window)
    roles = []
    for row, (state, term) in enumerate(held_to.coefficients):
        coef = model.terms(state).get(term, 0.0)
        follows = np.flatnonzero(held_to.C[row])
        process, alone = _alone(model, data, state, term, known) if ours else ("", np.nan)
        if sizes and processes:
            ends = (_ends(each) for each in held_to.processes if (state, term) in each.factors)
            process = "; ".join(_zone_words(*each) for each in ends)
        run = left_out[int(follows[0])] if follows.size else None
        roles.append(TermRole(state, term, coef, process, alone, run))
    return ModelBalance(processes, roles, data, period_s)


def _alone(
    model: SparseModel, data: Trajectory, state: str, term: str, known: Mapping[str, np.ndarray]
) -> tuple[str, float]:
    """A term's process in words, and the coefficient that would exchange as much alone."""
    coef = model.terms(state).get(term, 0.0)
    names, words = PLACES.get((state, _kind(term), coef > 0.0), ((), ""))
    if not names or not set(names) <= set(known):
        return words, np.nan
    column = model.library.evaluate(data.columns(model.library.variables))
    mean = float(column[:, model.library.index(term)].mean())
    return words, np.copysign(sum(float(known[name].mean()) for name in names) / mean, coef)


def _without(
    model: SparseModel,
    held_to: Constraint,
    free: int,
    train: Trajectory,
    held: Trajectory,
    bounds: FreeRunBounds,
    progress: Progress,
    *,
    window: int | None,
) -> FreeRun | None:
    """The model without one free coefficient, refined and run; None if it is not finite."""
    from ep2sindy.refinement.refine import refine, with_coef  # loads torch, only for a refinement

    less = _less(held_to, free)
    if {state for state, _ in less.coefficients} != set(model.states):
        return None
    values = np.array([model.terms(s).get(term, 0.0) for s, term in less.coefficients])
    start = with_coef(model, less, less.coef(values[less.free]))[0]
    found = refine(
        start, [train], window=window, constraint=less, n_reweights=0, seed=0, progress=progress
    )
    if found.status == "non_finite":
        return None
    return free_run(found.model, held, initial=start_of(held, found.model), bounds=bounds)


def _less(held_to: Constraint, free: int) -> Constraint:
    """The constraint without one free coefficient, and without those that follow from it alone."""
    C = np.delete(held_to.C, free, axis=1)
    kept = np.flatnonzero(C.any(axis=1) | (held_to.d != 0.0))
    places = {int(k): new for new, k in enumerate(kept)}
    return Constraint(
        held_to.states,
        tuple(held_to.coefficients[k] for k in kept),
        C[kept],
        held_to.d[kept],
        np.array([places[int(k)] for k in np.delete(held_to.free, free)], dtype=np.int64),
    )
