"""What a simulated record tells of the roles in its zone: rates by least squares on its balance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import xarray as xr
from jaxtyping import Float

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


def told_roles(balances: Mapping[str, xr.Dataset], run: Trajectory) -> dict[str, FittedRate]:
    """What the balances of zones tell about roles, over the samples of a run.

    balances: by zone, from `ep.thruster.zone_balance`; a single one is called "". The inflow is the
    mean supply of neutrals. In a single zone the neutrals that leave, and what walls and anode give
    back, are told by least squares. A role that a balance does not give is left out.
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
    size = np.abs(columns).max(axis=0)
    coef = np.linalg.lstsq(columns / size, rate, rcond=None)[0] / size
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
