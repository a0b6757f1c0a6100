"""Processes of ions and neutrals: as a simulation records them, and by the terms of a model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import xarray as xr
from jaxtyping import Float

from ep2sindy.data.numbers import least_squares
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import polynomial
from ep2sindy.library.relations import Constraint, Process
from ep2sindy.library.roles import process_amounts, process_matrix
from ep2sindy.model.model import SparseModel
from ep2sindy.model.scores import r2

IONS, NEUTRALS = "n_i", "n_n"

# Role -> what the balance calls it, and the terms that tell it: neutrals leave the faster the more
# ions there are, and walls and anode give back what reaches them.
TELLING: Mapping[str, tuple[str, Sequence[str]]] = {
    f"{NEUTRALS} out": ("exit_n", [NEUTRALS, f"{IONS}*{NEUTRALS}"]),
    f"{IONS} to {NEUTRALS}": ("returned", [IONS]),
}


@dataclass(frozen=True)
class Zones:
    """The zones of a record: balances of ions and neutrals, and lengths in m if there are several.

    balances: by name, from `ep.thruster.zone_balance`; a single one is called "".
    """

    balances: Mapping[str, xr.Dataset] = field(default_factory=dict)
    sizes: Mapping[str, float] = field(default_factory=dict)


NO_ZONES = Zones()


@dataclass(frozen=True)
class FittedRate:
    """A recorded rate by terms, their coefficients in SI, with R2 at each instant."""

    terms: Mapping[str, float]
    r2: float = float("nan")


def fit_roles(balances: Mapping[str, xr.Dataset], run: Trajectory) -> dict[str, FittedRate]:
    """What the balances of zones tell about roles, over the samples of a run.

    balances: by zone, from `ep.thruster.zone_balance`; a single one is called "". The inflow is the
    mean supply of neutrals. In a single zone the neutrals that leave, and what walls and anode give
    back, are fitted by least squares. A role that a balance does not give is left out.
    """
    found = {}
    for zone, balance in balances.items():
        if "supply" in balance:
            name = f"{NEUTRALS}@{zone} in" if zone else f"{NEUTRALS} in"
            found[name] = FittedRate({"1": float(balance["supply"].mean())})
    if "" not in balances or not {IONS, NEUTRALS} <= set(run.state_names):
        return found
    known, library = recorded_rates(balances[""], run), polynomial(run.state_names, degree=2)
    for role, (rate, terms) in TELLING.items():
        if rate in known:
            columns = library.evaluate(run.states)[:, [library.index(term) for term in terms]]
            found[role] = fitted_rate(known[rate], columns, terms)
    return found


def fitted_rate(
    rate: Float[np.ndarray, " samples"],
    columns: Float[np.ndarray, "samples terms"],
    terms: Sequence[str],
) -> FittedRate:
    """A rate by least squares on terms, whose values are the columns."""
    coef = least_squares(columns, rate)
    return FittedRate(dict(zip(terms, coef.tolist(), strict=True)), rate_r2(rate, columns @ coef))


def rate_r2(
    recorded: Float[np.ndarray, " samples"], modelled: Float[np.ndarray, " samples"]
) -> float:
    """R2 at each instant; NaN for a recorded rate that varies by no more than rounding."""
    if np.ptp(recorded) <= 1e-6 * np.abs(recorded).max():
        return float("nan")
    return float(r2(truth=recorded, prediction=modelled[None])[0])


def recorded_rates(balance: xr.Dataset, data: Trajectory) -> dict[str, np.ndarray]:
    """Terms of the balance at the samples of the trajectory."""
    there = np.isin(balance["time"].values, data.t)
    return {str(name): balance[name].values[there] for name in balance.data_vars}


@dataclass(frozen=True, eq=False)
class ComparedProcess:
    """A process of the zone: in the record and by the model's terms, in m^-3/s at every sample.

    ends: the state that gives, and the one that takes; "" is the outside. recorded: None if the
    record does not give it. coef: of the model's terms. counterpart: of the same terms, by least
    squares on the record; empty if it does not give the process. fit_r2: of these, at each instant.
    std: standard error of the mean of `modelled`; zero if all is known, NaN if it cannot be told.
    """

    name: str
    ends: tuple[str, str]
    recorded: Float[np.ndarray, " samples"] | None
    modelled: Float[np.ndarray, " samples"]
    coef: Mapping[str, float]
    counterpart: Mapping[str, float] = field(default_factory=dict)
    fit_r2: float = float("nan")
    std: float = float("nan")

    @property
    def ratio(self) -> float:
        """Mean rate of the model over that of the record; NaN if the record does not give it."""
        if self.recorded is None:
            return float("nan")
        return float(self.modelled.mean() / self.recorded.mean())

    @property
    def r2(self) -> float:
        """R2 at each instant; NaN for a rate that is constant or not recorded."""
        return float("nan") if self.recorded is None else rate_r2(self.recorded, self.modelled)


def compared_processes(
    model: SparseModel, held_to: Constraint, data: Trajectory, zones: Zones
) -> list[ComparedProcess]:
    """The processes of a model next to those of the record, in zones and between them.

    A record may tell those of ions and neutrals; others have the names of their roles.

    held_to: the model's constraint, from a search under `Roles`. Rates are those of the zone that
    gives, or takes from outside. Where ions give back by a process of their own, ionization is the
    whole of it; else what is given back is subtracted, as the model's terms are net of it. So is
    what leaves of a state for which the model has no outflow, unless its inflow is known.
    """
    theta = model.library.evaluate(data.columns(model.library.variables))
    found: dict[tuple[str, str], dict[str, float]] = {}
    roles: dict[tuple[str, str], dict[str, None]] = {}
    for process, amount in process_amounts(held_to, {s: model.terms(s) for s in model.states}):
        found.setdefault(ends_of(process), {})[process.term] = amount
        roles.setdefault(ends_of(process), {})[process.role] = None
    covariance, means = _amount_covariance(model, held_to), theta.mean(axis=0)
    known = {zone: recorded_rates(balance, data) for zone, balance in zones.balances.items()}
    gone = _through_ends(known, zones.sizes or dict.fromkeys(known, 1.0))
    given = {ends_of(process) for process in held_to.known}
    leaving = {g for g, taker in found if not taker or _zone(g) != _zone(taker)}
    compared = []
    # What enters comes first, what leaves last.
    for ends, terms in sorted(found.items(), key=lambda each: (bool(each[0][0]), not each[0][1])):
        columns = theta[:, [model.library.index(term) for term in terms]]
        gross = ends[::-1] in found if ends[0] else ends[1] in leaving or ends in given
        words = _zone_words(*ends, gross=gross)
        rate = _zone_rate(*ends, known, gone, gross=gross) if words else None
        modelled = columns @ np.array([*terms.values()])
        beside = fitted_rate(rate, columns, list(terms)) if rate is not None else FittedRate({})
        per_amount = [
            means[model.library.index(process.term)] * (ends_of(process) == ends)
            for process in held_to.processes
        ]
        std = float(np.sqrt(max(per_amount @ covariance @ per_amount, 0.0)))
        compared.append(
            ComparedProcess(
                words or " and ".join(roles[ends]), ends, rate, modelled, terms, beside.terms,
                beside.r2, std,
            )
        )  # fmt: skip
    return compared


def _amount_covariance(
    model: SparseModel, held: Constraint
) -> Float[np.ndarray, "processes processes"]:
    """Covariance of the coefficients of the processes to be found; NaN if the model has none."""
    if model.covariance is None:
        return np.full((len(held.processes), len(held.processes)), np.nan)
    used = [(model.states[k], model.library.names[j]) for k, j in np.argwhere(model.coef.T)]
    free = [held.coefficients[k] for k in held.free]
    chosen = np.array([[place == other for other in used] for place in free], dtype=np.float64)
    spread = np.linalg.solve(process_matrix(held), chosen)
    return spread @ model.covariance @ spread.T


def ends_of(process: Process) -> tuple[str, str]:
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
            if key not in known.get(zone, {}):
                break
            passed = passed + size * known[zone][key]
            found[state, zone] = passed / size
    return found


def _zone(state: str) -> str:
    return state.partition("@")[2]


def _zone_words(giver: str, taker: str, *, gross: bool) -> str:
    """What the balance calls a process of ions and neutrals; empty for other states."""
    (state, _, zone), (other, _, beyond) = giver.partition("@"), taker.partition("@")
    names = {IONS: "ions", NEUTRALS: "neutrals", "": ""}
    if not {state, other} <= {*names}:
        return ""
    if not giver:
        return f"{names[other]} that enter{'' if gross else ', less those that leave'}"
    if not taker:
        return f"{names[state]} that leave"
    if zone != beyond:
        return f"{names[state]} from {zone} to {beyond}"
    place = f"{zone}: " if zone else ""
    if gross:
        back = "" if state == NEUTRALS else ", back from walls and anode"
        return f"{place}{names[state]} that become {names[other]}{back}"
    given_back = "those given back" if zone else "those that walls and anode give back"
    return f"{place}{names[state]} that become {names[other]}, less {given_back}"


def _zone_rate(
    giver: str,
    taker: str,
    known: Mapping[str, Mapping[str, np.ndarray]],
    gone: Mapping[tuple[str, str], np.ndarray],
    *,
    gross: bool,
) -> np.ndarray | None:
    """The rate of a process in the record; None if it does not give it.

    gross: False subtracts what goes the other way, which the model has no process for.
    """
    (state, _, zone), (other, _, beyond) = giver.partition("@"), taker.partition("@")
    if not giver:
        supply = known.get(beyond, {}).get("supply") if other == NEUTRALS else None
        left = 0.0 if gross else gone.get((other, beyond))
        return None if supply is None or left is None else supply - left
    if not taker or zone != beyond:  # to the outside, or to the next zone
        return gone.get((state, zone))
    own = known.get(zone, {})
    if gross:
        return own.get("ionization" if state == NEUTRALS else "returned")
    if not {"ionization", "returned"} <= {*own}:
        return None
    exchanged = own["ionization"] - own["returned"]
    return exchanged if state == NEUTRALS else -exchanged
