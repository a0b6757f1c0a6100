"""Balance of ions and neutrals in a zone: what enters, leaves and is exchanged, at each sample."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import xarray as xr

from ep2sindy.data.fields import cell_sizes, grid_points
from ep2sindy.data.zones import Zone, resolve_zone, zone_average, zone_slices

DENSITIES = ("n_i", "n_n")
AVERAGED = ("dn_i_dt", "dn_n_dt", "face_flux_i", "face_flux_n", "ionization", "wall_loss", "dz")
CHARGES = ("", "2", "3")  # ends of the names of variables that every charge has
INFLOW = "neutral_inflow"  # attribute of a simulation: neutrals that enter at the anode, m^-2/s

Terms = dict[str, np.ndarray]


def zone_balance(
    field: xr.Dataset, zone: Zone | tuple[float, float], *, axisymmetric: bool = True
) -> xr.Dataset:
    """Terms of the balances of the zone averages of n_i and n_n, over time.

    A run of `simulate` with averages gives all terms exactly, for ions of all charges together.
    Other fields, with r or without, give ionization by n_i n_n R_ion, exit_i by n_i u_iz in the
    zone's last cells, and supply by the attribute `neutral_inflow` (m^-2/s) of the (z, r)
    simulator; `returned` and exit_n are then what is missing for the balance to close.

    Parameters
    ----------
    field : Dataset
        A simulation or a measured field.
    zone : Zone or (float, float)
        A `Zone` without r, or (from, to) in z in m.
    axisymmetric : bool, default True
        True if r is the radius of a cylinder.

    Returns
    -------
    Dataset
        As far as the field gives them, in m^-3/s: `change_i` and `change_n`, the changes of the
        averages; `ionization`, neutrals that become ions; `exit_i` and `exit_n`, what leaves
        through the end away from the anode, less what enters through the other end if this is not
        the anode; `returned`, ions that become neutrals at the walls and, in a zone that begins at
        the first grid point, at the anode; `supply`, neutrals that then enter there. For a run of
        `simulate` with averages also `inflow_i` and `inflow_n` (net, through both ends),
        `wall_loss`, and `residual`, the change of ions and neutrals less their inflow, which is
        zero but for rounding.

    Raises
    ------
    ValueError
        If the field lacks a density, the zone has no cells, or it holds the last cell of a
        simulation.

    Notes
    -----
    The balances are

        d<n_i>/dt = ionization - exit_i - returned
        d<n_n>/dt = supply - ionization - exit_n + returned
    """
    if missing := [name for name in DENSITIES if name not in field]:
        raise ValueError(
            f"a zone's balance is that of the densities n_i and n_n: this field lacks {missing}; "
            "name the file's variables so with data.rename"
        )
    zone = resolve_zone(zone if isinstance(zone, Zone) else Zone(z=zone), field)
    exact = all(name in field for name in AVERAGED) and "r" not in field.dims
    found = _averaged(field, zone) if exact else _estimated(field, zone, axisymmetric=axisymmetric)
    data = {name: (("time",), values, {"units": "m^-3/s"}) for name, values in found.items()}
    return xr.Dataset(data, coords={"time": field["time"]})


def _averaged(field: xr.Dataset, zone: Zone) -> Terms:
    """All terms from what a run with averages records."""
    inside = np.arange(field.sizes["z"])[zone_slices(field, zone).get("z", slice(None))]
    first, beyond = int(inside[0]), int(inside[-1]) + 1
    if beyond >= field.sizes["z"]:
        raise ValueError(
            f"a zone must end before the last cell, got {zone.z}, the cells' centres reach from "
            f"{float(field['z'][0]):g} to {float(field['z'][-1]):g} m"
        )
    dz = field["dz"].values[first:beyond].astype(float)
    if "area" in field and bool((field["area"][:, : beyond + 1] != 1.0).any()):
        raise ValueError(
            "a zone's balance holds where the cross-section is that of the channel: this zone "
            f"reaches to {float(field['z'][beyond - 1]):g} m, into the plume; end it at the exit"
        )

    def summed(name: str) -> np.ndarray:
        """Sum over the charge states of the run."""
        found = [field[each].values for k in CHARGES if (each := name + k) in field]
        return np.sum(found, axis=0, dtype=float)

    def mean(name: str) -> np.ndarray:
        return summed(name)[:, first:beyond] @ dz / dz.sum()

    (enter_i, exit_i), (enter_n, exit_n) = (
        summed(name)[:, [first, beyond]].T / dz.sum() for name in ("face_flux_i", "face_flux_n")
    )
    terms = {
        "change_i": mean("dn_i_dt"),
        "change_n": mean("dn_n_dt"),
        "inflow_i": enter_i - exit_i,
        "inflow_n": enter_n - exit_n,
        "ionization": mean("ionization"),
        "wall_loss": mean("wall_loss"),
        "exit_i": exit_i,
        "exit_n": exit_n,
        "returned": mean("wall_loss"),
    }
    if first == 0:  # ions that reach the anode come back as neutrals
        terms["returned"] = terms["returned"] - enter_i
        terms["supply"] = enter_n + enter_i
    else:
        terms["exit_i"] = exit_i - enter_i
        terms["exit_n"] = exit_n - enter_n
    terms["residual"] = (
        terms["change_i"] + terms["change_n"] - terms["inflow_i"] - terms["inflow_n"]
    )
    return terms


def _estimated(field: xr.Dataset, zone: Zone, *, axisymmetric: bool) -> Terms:
    """The terms that averages of the field's variables give, and what closes the balance."""
    t = grid_points(field, "time")
    average = partial(zone_average, states=DENSITIES, axisymmetric=axisymmetric)
    inside = average(field, zone)

    def over_time(values: np.ndarray, run: Any) -> np.ndarray:
        """At all samples of the field; NaN where the average lacks one."""
        return np.interp(t, run.t, values, left=np.nan, right=np.nan)

    terms: Terms = {
        f"change_{name[-1]}": over_time(np.gradient(values, inside.t), inside)
        for name, values in zip(DENSITIES, inside.states.T, strict=True)
    }
    if "R_ion" in field:
        run = average(field, zone, products=["n_i*n_n*R_ion"])
        terms["ionization"] = over_time(run.inputs[:, 0], run)
    if "z" not in field.dims:
        return terms
    slices = zone_slices(field, zone).get("z", slice(None))
    inner = range(field.sizes["z"])[slices]
    length_m = float(cell_sizes(field, "z", axisymmetric=axisymmetric)[slices].sum())
    if "u_iz" in field:

        def flux(cell: int) -> np.ndarray:
            run = average(field.isel(z=[cell]), None, products=["n_i*u_iz"])
            return over_time(run.inputs[:, 0], run) / length_m

        terms["exit_i"] = flux(inner[-1]) - (flux(inner[0] - 1) if inner[0] else 0.0)
    if inner[0] == 0 and INFLOW in field.attrs:
        terms["supply"] = np.full(len(t), float(field.attrs[INFLOW]) / length_m)
    # What the others leave: ions that the walls return, and neutrals that exit.
    if {"ionization", "exit_i"} <= terms.keys():
        terms["returned"] = terms["ionization"] - terms["exit_i"] - terms["change_i"]
    if {"supply", "exit_i"} <= terms.keys():
        changes = terms["change_i"] + terms["change_n"]
        terms["exit_n"] = terms["supply"] - terms["exit_i"] - changes
    return terms
