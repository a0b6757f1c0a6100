"""Record of a run of the axial model, as an xarray.Dataset with names and units."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr
from jaxtyping import Float

from ep2sindy.data.zones import FACES
from ep2sindy.thruster.axial import state_kernels as recorded
from ep2sindy.thruster.axial.state_kernels import AxialModel
from ep2sindy.thruster.constants import E_CHARGE
from ep2sindy.thruster.plume import Plume
from ep2sindy.thruster.recording import as_dataset, notes

FIELDS = {  # variable -> index among the cell sums, unit, long name
    "n_i": (recorded.N_I, "m^-3", "ion density"),
    "u_iz": (recorded.U_IZ, "m/s", "axial ion velocity"),
    "n_n": (recorded.N_N, "m^-3", "neutral density"),
    "T_e_eV": (recorded.T_E, "eV", "electron temperature"),
    "R_ion": (recorded.R_ION, "m^3/s", "ionisation rate coefficient"),
    "E_z": (recorded.E_Z, "V/m", "axial electric field"),
}
# Averages of products, and the terms that close a sample's balance; recorded with averages only.
AVERAGES = {
    "ionization": (recorded.IONIZATION, "m^-3/s", "neutrals ionised per volume and time"),
    "flux_i": (recorded.FLUX_I, "m^-2/s", "ion flux"),
    "energy_e": (recorded.ENERGY, "eV*m^-3", "heat of the electrons per volume"),
    "wall_loss": (recorded.WALL_LOSS, "m^-3/s", "ions lost to the walls"),
    "face_flux_i": (recorded.FACE_I, "m^-2/s", "ion flux through the cell's face to the anode"),
    "face_flux_n": (recorded.FACE_N, "m^-2/s", "neutral flux through that face"),
    "dn_i_dt": (recorded.CHANGE_I, "m^-3/s", "change of n_i over the sample"),
    "dn_n_dt": (recorded.CHANGE_N, "m^-3/s", "change of n_n over the sample"),
}
SPREAD = {"area": (recorded.SPREAD, "1", "cross-section of the plasma over the channel's")}
OF_CHARGE = ("n_i", "u_iz", "flux_i", "face_flux_i", "dn_i_dt")
# Variable -> the product it averages; a second charge state has its own ionisation rates.
PRODUCTS = {"ionization": "n_i*n_n*R_ion", "flux_i": "n_i*u_iz"}
FACE_PRODUCTS = {f"face_flux_i{k}": f"n_i{k}*u_iz{k}" for k in ("", "2", "3")}
FACE_PRODUCTS |= {"face_flux_n": "n_n*u_n"}  # whose velocity is set, and not recorded

SERIES = {  # variable -> unit, long name
    "I_d": ("A", "discharge current"),
    "V_d": ("V", "discharge voltage behind resistance and circuit"),
    "V_supply": ("V", "voltage of the supply"),
    "half_angle": ("degree", "half-angle of the plume at the cathode plane"),
    "thrust": ("N", "ion momentum flux through the cathode plane"),
    "I_beam": ("A", "ion current through the cathode plane"),
    "I_wall": ("A", "ion current to the channel walls"),
    "mass_flow_i": ("kg/s", "ions leaving through the cathode plane"),
    "mass_flow_n": ("kg/s", "neutrals leaving through the cathode plane"),
    "mass_out": ("kg", "propellant that left through the cathode plane since the first sample"),
    "P_in": ("W", "power that the plasma takes from the supply"),
    "P_ions": ("W", "work of the field on the ions"),
    "P_inelastic": ("W", "electron power lost in ionisation and excitation"),
    "P_wall": ("W", "electron power lost to the walls"),
    "P_anode": ("W", "electron power lost to the anode"),
    "P_cathode": ("W", "electron power lost through the cathode plane"),
}
POWERS = ("P_in", "P_ions", "P_inelastic", "P_wall", "P_anode", "P_cathode")


def field_columns(
    *, charges: int, averaged: bool, spreads: bool = False
) -> dict[str, tuple[int, str, str]]:
    """Variables of a run: index among the cell sums, unit and long name."""
    first = FIELDS | (AVERAGES if averaged else {}) | (SPREAD if spreads else {})
    columns = dict(first)
    for k in range(1, charges):
        for name in OF_CHARGE:
            if name in first:
                place, unit, text = first[name]
                text = f"{text}, charge {k + 1}"
                columns[f"{name}{k + 1}"] = (place + recorded.PER_CHARGE * k, unit, text)
    return columns


def series_of(
    sums: Float[np.ndarray, "samples series"],
    model: AxialModel,
    *,
    cathode_V: float,
    sample_s: float,
    plume: Plume | None,
) -> dict[str, Float[np.ndarray, " samples"]]:
    """The named time series of a run. cathode_V: potential of the cathode plane."""
    current = sums[:, recorded.CURRENT]
    particles = model.ion_mass * model.area
    flow_i, flow_n = sums[:, recorded.IONS_OUT], sums[:, recorded.NEUTRALS_OUT]
    powers = sums[:, recorded.POWER : recorded.P_CATHODE + 1].T
    some = {"V_supply": cathode_V + sums[:, recorded.SUPPLY]} if model.supply.size > 1 else {}
    angle = np.arctan(sums[:, recorded.TANGENT])
    if plume is not None:
        some["half_angle"] = np.degrees(angle)
    axial = plume is not None and plume.axial_thrust
    return {
        "I_d": current,
        "V_d": cathode_V + sums[:, recorded.VOLTAGE],
        **some,
        "thrust": sums[:, recorded.THRUST] * (np.cos(angle) if axial else 1.0),
        "I_beam": E_CHARGE * model.area * sums[:, recorded.BEAM],
        "I_wall": sums[:, recorded.WALL_CURRENT],
        "mass_flow_i": particles * flow_i,
        "mass_flow_n": particles * flow_n,
        "mass_out": particles * sample_s * np.cumsum(flow_i + flow_n),
        **dict(zip(POWERS, powers, strict=True)),
    }


def labelled(
    columns: Mapping[str, tuple[int, str, str]],
    fields: Float[np.ndarray, "sums samples cells"],
    series: Mapping[str, Float[np.ndarray, " samples"]],
    end: Mapping[str, tuple[Float[np.ndarray, " cells"], str]],
    *,
    sample_s: float,
    faces: Float[np.ndarray, " faces"],
) -> xr.Dataset:
    """Label the recorded arrays with dimensions, units and names. columns: by `field_columns`."""
    data: dict[str, Any] = {}
    for name, (place, unit, text) in columns.items():
        data[name] = (("time", "z"), fields[place], notes(unit, text))
        if name in PRODUCTS and (name != "ionization" or "n_i2" not in columns):
            data[name][-1]["average_of"] = PRODUCTS[name]
        if name in FACE_PRODUCTS:
            data[name][-1][FACES] = FACE_PRODUCTS[name]
    for name, column in series.items():
        data[name] = (("time",), column, notes(*SERIES[name]))
    for name, (profile, unit) in end.items():
        data[name] = (("z",), profile, notes(unit, "at the end, for a restart"))
    data["dz"] = (("z",), np.diff(faces), notes("m", "length of the cell"))
    n_samples = len(next(iter(series.values())))
    centres = 0.5 * (faces[1:] + faces[:-1])
    return as_dataset(data, sample_s=sample_s, n_samples=n_samples, z=centres)
