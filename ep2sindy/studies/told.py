"""What a simulated record tells of the roles in its zone: rates by least squares on its balance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import polynomial
from ep2sindy.model.scores import r2

IONS, NEUTRALS = "n_i", "n_n"

# Role -> what the balance calls it, and the terms that tell it: neutrals leave the faster the more
# ions there are, and walls and anode give back what reaches them.
TELLING: Mapping[str, tuple[str, Sequence[str]]] = {
    f"{NEUTRALS} out": ("exit_n", [NEUTRALS, f"{IONS}*{NEUTRALS}"]),
    f"{IONS} to {NEUTRALS}": ("returned", [IONS]),
}


@dataclass(frozen=True)
class ToldRole:
    """A role as the record gives it: its terms with coefficients in SI, and R2 at each instant."""

    terms: Mapping[str, float]
    r2: float


def told_roles(balances: Mapping[str, xr.Dataset], run: Trajectory) -> dict[str, ToldRole]:
    """What the balances of zones tell about roles, over the samples of a run.

    balances: by zone, from `ep.thruster.zone_balance`; a single one is called "". The inflow is the
    mean supply of neutrals. In a single zone the neutrals that leave, and what walls and anode give
    back, are told by least squares. A role that a balance does not give is left out.
    """
    found = {}
    for zone, balance in balances.items():
        if "supply" in balance:
            name = f"{NEUTRALS}@{zone} in" if zone else f"{NEUTRALS} in"
            found[name] = ToldRole({"1": float(balance["supply"].mean())}, 1.0)
    known = recorded_rates(balances[""], run) if "" in balances else {}
    for role, (rate, terms) in TELLING.items():
        if rate in known and {IONS, NEUTRALS} <= set(run.state_names):
            found[role] = fitted_rate(known[rate], run, terms)
    return found


def fitted_rate(rate: np.ndarray, run: Trajectory, terms: Sequence[str]) -> ToldRole:
    """A rate at every sample of a run by least squares on terms of its states."""
    library = polynomial(run.state_names, degree=3)
    theta = library.evaluate(run.states)[:, [library.index(term) for term in terms]]
    size = np.abs(theta).max(axis=0)
    coef = np.linalg.lstsq(theta / size, rate, rcond=None)[0] / size
    score = float(r2(truth=rate, prediction=(theta @ coef)[None])[0])
    return ToldRole(dict(zip(terms, coef.tolist(), strict=True)), score)


def recorded_rates(balance: xr.Dataset, data: Trajectory) -> dict[str, np.ndarray]:
    """Terms of the balance at the samples of the trajectory."""
    there = np.isin(balance["time"].values, data.t)
    return {str(name): balance[name].values[there] for name in balance.data_vars}


def is_constant(rate: np.ndarray) -> bool:
    """Whether a rate varies by no more than rounding, so that no R2 can be given."""
    return bool(np.ptp(rate) <= 1e-6 * np.abs(rate).max())
