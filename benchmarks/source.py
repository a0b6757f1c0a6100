"""How far the embedded thruster model can be relied on: `python -m benchmarks.source`.

One cycle at every operating point, from hard and soft starts, on several grids and time steps;
balances; no alternation of T_e; and, with EP2SINDY_DATA=folder, LANDMARK's three fluid cases.
Prints the tables of docs/thruster.md; tests/test_thruster_reference.py holds them.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import xarray as xr

import ep2sindy as ep
from ep2sindy.library.library import named_terms
from ep2sindy.regression.splits import RandomSplit
from ep2sindy.search.front import fit_support
from ep2sindy.thruster.landmark import read_landmark_rates

POINTS = {point.label: point for point in ep.OPERATING_POINTS}
DOWNSTREAM = (1.5e-2, 2.5e-2)  # m
EQUATIONS = (
    ("n_i", ("n_i", "n_i*n_n")),
    ("n_n", ("1", "n_i", "n_n")),
    ("n_i", ("n_i*u_iz", "n_i*n_n*R_ion")),
    ("n_n", ("1", "n_n", "n_i*n_n*R_ion")),
)
VARIANTS: dict[str, dict] = {
    "guessed start, N = 100": {},
    "hard start": {"initial": ep.ColdStart()},
    "soft start": {"initial": ep.SoftStart()},
    "N = 200": {"n_cells": 200},
    "CFL 0.2": {"cfl": 0.2},
    "uniform, N = 100": {"stretch": 1.0},
}
RATE_TABLE = Path(os.environ.get("EP2SINDY_DATA", ".")) / "landmark_rates.csv"
# Means over 1.5 to 2 ms of HallThruster.jl's stored runs, N = 200: I_d and its deviation (A).
LANDMARK = {1: (8.19, 0.40), 2: (8.09, 0.09), 3: (7.88, 3.34)}


@cache
def full_run(label: str, variant: str, *, warm_up_s: float = 4e-3, duration_s: float = 4e-3):
    """One operating point of the default thruster, after its start is forgotten."""
    return ep.simulate(
        ep.Thruster(), POINTS[label], duration_s=duration_s, warm_up_s=warm_up_s, progress=False,
        **VARIANTS[variant],
    )  # fmt: skip


def zone_coefficients(run: xr.Dataset) -> np.ndarray:
    """Least-squares coefficients of the models of `EQUATIONS` on the downstream zone."""
    form = ep.Differential(split=RandomSplit(test_fraction=0.0))
    data = ep.zone_average(
        run, ep.Zone(z=DOWNSTREAM), states=["n_i", "n_n"], inputs=["u_iz", "R_ion"]
    )
    names = list(dict.fromkeys(name for _, terms in EQUATIONS for name in terms))
    library = named_terms(data.names, names)
    (problem,) = form.assemble([data], library, rng=np.random.default_rng(0))
    fits = [(fit_support(problem, state, terms).coef_by_term, terms) for state, terms in EQUATIONS]
    return np.array([coef[name] for coef, terms in fits for name in terms])


def alternation_eV(label: str, *, n_steps: int = 4000) -> float:
    """Largest half swing of a T_e that goes up and down in turn over five time steps.

    What fast ion transits do within two or three steps is physics, not numerics.
    """
    run = full_run(label, "guessed start, N = 100")
    steps = ep.simulate(
        ep.Thruster(), POINTS[label], initial=run, averaged=False, sample_s=1.5e-8,
        duration_s=1.5e-8 * n_steps, warm_up_s=0.0, progress=False,
    )  # fmt: skip
    change = np.diff(steps["T_e_eV"].values.astype(float), axis=0)
    windows = np.lib.stride_tricks.sliding_window_view(change, 5, axis=0)
    in_turn = np.all(windows[..., 1:] * windows[..., :-1] < 0.0, axis=-1)
    return float(np.max(0.5 * np.abs(windows).min(axis=-1), where=in_turn, initial=0.0))


def landmark_run(case: int, **settings) -> xr.Dataset:
    """LANDMARK's case on HallThruster.jl's grid: N = 200, inner radius 34.5 mm."""
    rates = read_landmark_rates(RATE_TABLE)
    thruster = replace(ep.landmark_thruster(case, rates), inner_radius=0.0345)
    return ep.simulate(
        thruster, ep.LANDMARK_POINT, duration_s=2e-3, warm_up_s=0.0, n_cells=200,
        reconstruct=case > 1, progress=False, **settings,
    )  # fmt: skip


def late(run: xr.Dataset) -> xr.Dataset:
    """The part that HallThruster.jl averages: from 1.5 to 2 ms."""
    return run.sel(time=slice(1.5e-3, 2e-3))


def row(run: xr.Dataset) -> str:
    a = run.attrs
    return f"{a['I_d_mean']:5.2f} / {a['I_d_std']:4.2f} / {a['f_kHz']:5.2f}"


def print_cycles() -> None:
    print("I_d mean / std (A) / frequency (kHz), 4 to 8 ms\n")
    print(f"{'V, mg/s':10s}" + "".join(f"| {name:24s}" for name in VARIANTS))
    for label in POINTS:
        cells = [row(full_run(label, name)) for name in VARIANTS]
        print(f"{label:10s}" + "".join(f"| {cell:24s}" for cell in cells))
    print("\nzone coefficients, N = 200 over N = 100: median and largest deviation")
    for label in POINTS:
        coarse, fine = (
            zone_coefficients(full_run(label, name))
            for name in ("guessed start, N = 100", "N = 200")
        )
        off = np.abs(fine / coarse - 1.0)
        print(f"{label:10s} {np.median(off):.3f}, {off.max():.3f}")


def print_balances() -> None:
    print("\nbalances: zone residual / largest term, outflow / mass flow, mass, energy; T_e turns")
    for label in POINTS:
        run = full_run(label, "guessed start, N = 100")
        balance = ep.zone_balance(run, DOWNSTREAM)
        top = max(float(abs(balance[n]).max()) for n in balance if n != "residual")
        residual = float(abs(balance["residual"]).max()) / top
        out = float((run["mass_flow_i"] + run["mass_flow_n"]).mean())
        share = out / (1e-6 * POINTS[label].mass_flow_mg_s)
        mass, energy = run.attrs["mass_balance"], run.attrs["energy_balance"]
        turns = alternation_eV(label)
        print(f"{label:10s} {residual:.1e}  {share:.5f}  {mass:.7f}  {energy:.7f}  {turns:.1e} eV")


def print_landmark() -> None:
    if not RATE_TABLE.exists():
        print("\nLANDMARK: name the folder of landmark_rates.csv with EP2SINDY_DATA")
        return
    print("\nLANDMARK, N = 200, 1.5 to 2 ms: I_d mean / std (A), theirs")
    for case, theirs in LANDMARK.items():
        part = late(landmark_run(case))["I_d"]
        print(f"case {case}: {float(part.mean()):.2f} / {float(part.std()):.2f}, {theirs}")


def main() -> None:
    """Print every table, or those that are named: cycles, balances, landmark."""
    parts: dict[str, Callable[[], None]] = {
        "cycles": print_cycles, "balances": print_balances, "landmark": print_landmark,
    }  # fmt: skip
    for name in sys.argv[1:] or parts:
        began = time.process_time()
        parts[name]()
        print(f"({time.process_time() - began:.0f} CPU-s)")


if __name__ == "__main__":
    main()
