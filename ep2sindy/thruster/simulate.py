"""Run the axial fluid model and return what it did as an xarray.Dataset."""

from __future__ import annotations

import json
from dataclasses import asdict, is_dataclass
from typing import Any

import numpy as np
import xarray as xr
from jaxtyping import Float
from tqdm import tqdm

from ep2sindy.signals.spectrum import dominant_frequency
from ep2sindy.thruster import kernels
from ep2sindy.thruster.discretization import build_model, cell_centres, initial_state
from ep2sindy.thruster.parameters import OperatingPoint, Thruster

CHUNK_ROWS = 50  # samples between two updates of the progress bar
MIN_STEPS = 16  # fewer leave nothing to judge an oscillation by

FIELDS = {  # variable -> unit, long name, in the order the compiled loop fills them
    "n_i": ("m^-3", "ion density"),
    "u_iz": ("m/s", "axial ion velocity"),
    "n_n": ("m^-3", "neutral density"),
    "T_e_eV": ("eV", "electron temperature"),
    "R_ion": ("m^3/s", "ionisation rate coefficient"),
    "E_z": ("V/m", "axial electric field"),
}
SERIES = {
    "I_d": ("A", "discharge current"),
    "V_d": ("V", "discharge voltage behind the series resistance"),
    "thrust": ("N", "ion momentum flux through the cathode plane"),
    "mass_out": ("kg", "xenon that left through the cathode plane since the start"),
}


def simulate(
    thruster: Thruster,
    operating_point: OperatingPoint,
    *,
    duration_s: float = 18e-3,
    warm_up_s: float = 2e-3,
    sample_s: float = 1.5e-6,
    n_cells: int = 100,
    progress: bool = True,
) -> xr.Dataset:
    """Simulate one operating point and sample it at equal steps after a warm-up.

    Returns a Dataset on ("time", "z"), time in s from the end of the warm-up, with the fields
    (float32) and series (float64) named in FIELDS and SERIES. Its attributes hold the
    parameters as JSON, `status` (oscillating, steady, decaying or diverged; see
    `judge_status`), `f_kHz`, the mean and standard deviation of I_d, and `mass_balance`.
    A diverged run ends at its last finite sample and says so; it is not an error.
    Raises ValueError for settings that cannot be run.
    """
    check_settings(duration_s, warm_up_s, sample_s, n_cells)
    model = build_model(thruster, operating_point, n_cells)
    state = initial_state(thruster, model)
    n_warm_up = round(warm_up_s / sample_s)
    n_samples = round(duration_s / sample_s) + 1
    rows = run(model, state, n_warm_up + n_samples, sample_s, operating_point.label, progress)
    diverged = len(rows["I_d"]) < n_warm_up + n_samples
    if len(rows["I_d"]) > n_warm_up:
        rows = {name: values[n_warm_up:] for name, values in rows.items()}
    rows["V_d"] = operating_point.voltage - thruster.series_resistance * rows["I_d"]
    field = as_dataset(rows, sample_s, cell_centres(thruster, n_cells))
    settings = {
        "duration_s": duration_s, "warm_up_s": warm_up_s, "sample_s": sample_s, "n_cells": n_cells,
    }  # fmt: skip
    parameters = {"thruster": thruster, "operating_point": operating_point, "settings": settings}
    field.attrs = {
        "title": "1-D axial Hall-thruster fluid model",
        "parameters": to_json(parameters),
        **diagnose(field, operating_point, thruster, diverged=diverged),
    }
    return field


def check_settings(duration_s: float, warm_up_s: float, sample_s: float, n_cells: int) -> None:
    """Raise ValueError where a run could not start or could not be sampled."""
    if not (np.isfinite(sample_s) and sample_s > 0.0):
        raise ValueError(f"sample_s must be finite and positive, got {sample_s!r} s")
    if not (np.isfinite(warm_up_s) and warm_up_s >= 0.0):
        raise ValueError(f"warm_up_s must be finite and zero or more, got {warm_up_s!r} s")
    if not (np.isfinite(duration_s) and duration_s >= MIN_STEPS * sample_s):
        raise ValueError(
            f"duration_s must hold at least {MIN_STEPS} sampling steps of {sample_s!r} s, "
            f"got {duration_s!r} s"
        )
    if n_cells < 10:
        raise ValueError(f"n_cells must be 10 or more to resolve the channel, got {n_cells}")


def run(
    model: kernels.Model,
    state: kernels.State,
    n_rows: int,
    sample_s: float,
    label: str,
    progress: bool,
) -> dict[str, np.ndarray]:
    """Advance `state` by n_rows samples in chunks; fewer rows come back where it diverges."""
    n_cells = state.n_i.size - 2
    rows: dict[str, np.ndarray] = {name: np.empty((n_rows, n_cells), np.float32) for name in FIELDS}
    rows |= {name: np.empty(n_rows) for name in ("I_d", "thrust", "mass_out")}
    filled = 0
    bar = tqdm(total=n_rows, desc=label, unit="sample", disable=not progress)
    with bar, np.errstate(all="ignore"):
        while filled < n_rows:
            chunk = [values[filled : filled + CHUNK_ROWS] for values in rows.values()]
            done, _ = kernels.advance(state, model, sample_s, *chunk)
            filled += done
            bar.update(done)
            if done < len(chunk[0]):
                break
    return {name: values[:filled] for name, values in rows.items()}


def as_dataset(
    rows: dict[str, np.ndarray], sample_s: float, z: Float[np.ndarray, " z"]
) -> xr.Dataset:
    """Label the sampled arrays with dimensions, units and names."""
    time = sample_s * np.arange(len(rows["I_d"]))
    data = {
        name: (("time", "z"), rows[name], {"units": unit, "long_name": text})
        for name, (unit, text) in FIELDS.items()
    }
    series = {
        name: (("time",), rows[name], {"units": unit, "long_name": text})
        for name, (unit, text) in SERIES.items()
    }
    coords = {
        "time": ("time", time, {"units": "s", "long_name": "time after the warm-up"}),
        "z": ("z", z, {"units": "m", "long_name": "axial distance from the anode"}),
    }
    # "s" is a unit here, not a calendar: decode with decode_times=False
    return xr.Dataset({**data, **series}, coords=coords)


def diagnose(
    field: xr.Dataset, point: OperatingPoint, thruster: Thruster, *, diverged: bool
) -> dict[str, Any]:
    """Status, dominant frequency, current and mass balance of a finished run."""
    current = field["I_d"].values
    status = "diverged" if diverged else judge_status(current)
    oscillates = status == "oscillating"
    return {
        "status": status,
        "f_kHz": 1e-3 * dominant_frequency(field["time"].values, current) if oscillates else np.nan,
        "I_d_mean": float(current.mean()) if current.size else np.nan,
        "I_d_std": float(current.std()) if current.size else np.nan,
        "mass_balance": mass_balance(field, point, thruster) if current.size > 1 else np.nan,
    }


def judge_status(current: Float[np.ndarray, " time"]) -> str:
    """Say whether the current still oscillates at the end of the record.

    The second half is cut into four blocks: steady if the last one varies by less than 2 % of
    its mean, decaying if it holds less than 0.7 of the first one's amplitude.
    Some sets oscillate for 2 ms and die by 3 ms: a verdict needs 4 ms or more of simulated time.
    """
    blocks = np.array_split(current[current.size // 2 :], 4)
    first, last = blocks[0].std(), blocks[-1].std()
    if last < 0.02 * abs(blocks[-1].mean()):
        return "steady"
    return "decaying" if last < 0.7 * first else "oscillating"


def mass_balance(field: xr.Dataset, point: OperatingPoint, thruster: Thruster) -> float:
    """Xenon that left plus xenon that accumulated, over xenon that entered."""
    left = float(field["mass_out"][-1] - field["mass_out"][0])
    first, last = (field["n_i"] + field["n_n"]).isel(time=[0, -1]).astype(float).sum("z").values
    dz = float(field["z"][1] - field["z"][0])
    accumulated = thruster.propellant.mass * thruster.area * dz * float(last - first)
    entered = 1e-6 * point.mass_flow_mg_s * float(field["time"][-1])
    return (left + accumulated) / entered


def to_json(parameters: dict[str, Any]) -> str:
    """Nested dataclasses as JSON, each with the name of its class, keys sorted."""

    def plain(value: Any) -> Any:
        if is_dataclass(value) and not isinstance(value, type):
            members = {name: plain(getattr(value, name)) for name in asdict(value)}
            return {"class": type(value).__name__, **members}
        if isinstance(value, dict):
            return {name: plain(member) for name, member in value.items()}
        return list(value) if isinstance(value, tuple) else value

    return json.dumps(plain(parameters), sort_keys=True)
