"""Balance of ions and neutrals in a zone: the change inside against the flux through its ends."""

from __future__ import annotations

import numpy as np
import xarray as xr

NEEDED = ("dn_i_dt", "dn_n_dt", "face_flux_i", "face_flux_n", "ionization", "wall_loss", "dz")
CHARGES = ("", "2", "3")  # ends of the names of variables that every charge has


def zone_balance(field: xr.Dataset, z: tuple[float, float]) -> xr.Dataset:
    """Terms of d<n>/dt over the cells whose centres lie in z = (from, to) in m; in m^-3/s, by time.

    field: a run of `simulate` with averages; the zone must end before the last cell. Returns, for
    ions of all charges together, `change_i`, `change_n` (of the zone averages), `inflow_i`,
    `inflow_n` (net inflow through its two ends), `ionization`, `wall_loss` and `residual`: the
    change of ions and neutrals less their inflow, which is zero but for rounding. Raises ValueError
    for a field without averages, a zone without cells, or one with the last cell.
    """
    if missing := [name for name in NEEDED if name not in field]:
        raise ValueError(
            f"a zone's balance needs a simulation with averages: this field lacks {missing}; "
            "simulate with averaged=True"
        )
    inside = np.flatnonzero((field["z"].values >= z[0]) & (field["z"].values <= z[1]))
    if inside.size == 0 or inside[-1] + 1 >= field.sizes["z"]:
        raise ValueError(
            f"a zone must hold cells and end before the last one: z from {z[0]:g} to {z[1]:g} m "
            f"came, the cells' centres reach from {float(field['z'][0]):g} to "
            f"{float(field['z'][-1]):g} m"
        )
    first, beyond = int(inside[0]), int(inside[-1]) + 1
    dz = field["dz"].values[first:beyond].astype(float)
    _check_in_channel(field, beyond)

    def summed(name: str) -> np.ndarray:
        """Sum over the charge states of the run."""
        found = [field[each].values for k in CHARGES if (each := name + k) in field]
        return np.sum(found, axis=0, dtype=float)

    def mean(name: str) -> np.ndarray:
        return summed(name)[:, first:beyond] @ dz / dz.sum()

    def inflow(name: str) -> np.ndarray:
        through = summed(name)
        return (through[:, first] - through[:, beyond]) / dz.sum()

    terms = {
        "change_i": mean("dn_i_dt"),
        "change_n": mean("dn_n_dt"),
        "inflow_i": inflow("face_flux_i"),
        "inflow_n": inflow("face_flux_n"),
        "ionization": mean("ionization"),
        "wall_loss": mean("wall_loss"),
    }
    terms["residual"] = (
        terms["change_i"] + terms["change_n"] - terms["inflow_i"] - terms["inflow_n"]
    )
    data = {name: (("time",), values, {"units": "m^-3/s"}) for name, values in terms.items()}
    return xr.Dataset(data, coords={"time": field["time"]})


def _check_in_channel(field: xr.Dataset, beyond: int) -> None:
    """Raise ValueError if the plasma's cross-section changes within a zone's cells."""
    if "area" in field and bool((field["area"][:, : beyond + 1] != 1.0).any()):
        raise ValueError(
            "a zone's balance holds where the cross-section is that of the channel: this zone "
            f"reaches to {float(field['z'][beyond - 1]):g} m, into the plume; end it at the exit"
        )
