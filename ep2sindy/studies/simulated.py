"""Checks and messages for simulations used as data, and compilation of their kernels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import xarray as xr

from ep2sindy.report.run import Run
from ep2sindy.studies.study import Deferred

MIN_SAMPLES = 200  # some breathing periods at the usual step; fewer cannot be judged
GLIMPSE_SAMPLES = 20
BALANCE_TOLERANCE = 1e-3  # relative to the inflow; a float32 record closes to 1e-4
BALANCES = {"mass_balance": "mass", "energy_balance": "energy"}
VERDICTS = {
    "diverged": "the simulation diverged: the end of its record is no physics",
    "out": "the discharge has gone out: there is no plasma to learn from",
    "steady": "the simulation is steady: there is no oscillation to learn from",
    "decaying": "the simulation's oscillation dies out: what is found describes a transient",
}


class DivergedError(ValueError):
    """A run that diverged before it had recorded enough to study."""


def is_simulation(attributes: Mapping[str, Any]) -> bool:
    """Whether these are the attributes of a run of this package's simulators."""
    return {"status", "I_d_mean", "I_d_std", "parameters"} <= set(attributes)


def check_recorded(field: xr.Dataset) -> None:
    """Raise DivergedError for a run that diverged before it had recorded enough to study."""
    if is_simulation(field.attrs) and field.attrs["status"] == "diverged":
        n_samples = field.sizes["time"]
        if n_samples < MIN_SAMPLES:
            raise DivergedError(
                f"the simulation must record {MIN_SAMPLES} samples or more to be studied: it "
                f"diverged after {n_samples}; try shorter steps (++data.cfl=0.4), more cells, "
                "other parameters or another start; +exp=simulate shows what it did"
            )


def amiss(attributes: Mapping[str, Any]) -> list[str]:
    """Warnings about a simulation, empty if there are none."""
    status = attributes["status"]
    if status == "oscillating":
        return doubts(attributes)
    if status == "transit":
        verdict = (
            f"the simulation oscillates at {attributes['f_kHz']:.3g} kHz, above 60 kHz: that is "
            "ions in transit, not breathing"
        )
    else:
        verdict = VERDICTS.get(status, f"the simulation is {status}")
    return [verdict, *doubts(attributes)]


def doubts(attributes: Mapping[str, Any]) -> list[str]:
    """Warnings besides the status: rates used beyond their table, balances that do not close."""
    found = []
    if (rates := attributes.get("rates", "covered")) != "covered":
        found.append(str(rates))
    for name, words in BALANCES.items():
        value = attributes.get(name, 1.0)
        if not abs(value - 1.0) <= BALANCE_TOLERANCE:  # a NaN balance fails, too
            found.append(
                f"the simulation's {words} balance does not close: (out + stored)/in is {value:.4f}"
            )
    return found


def say_simulation(run: Run, attributes: Mapping[str, Any]) -> None:
    """Report a simulation in one line, with its warnings, on screen, page and in the summary."""
    if not is_simulation(attributes):
        return
    known = [name for name in BALANCES if name in attributes]
    balances = ", ".join(f"{BALANCES[name]} {attributes[name]:.4f}" for name in known)
    run.say(
        f"simulation: {status_text(attributes)}, from {attributes.get('initial', 'its start')}; "
        f"I_d {attributes['I_d_mean']:.2f} A, std {attributes['I_d_std']:.2f} A; "
        f"out/in {balances or 'unknown'}"
    )
    for text in amiss(attributes):
        run.warn(text)


def status_text(attributes: Mapping[str, Any]) -> str:
    """`oscillating, strong cycle`; the status alone if there is no cycle."""
    cycle = attributes.get("cycle", "none")
    return attributes["status"] + (f", {cycle} cycle" if cycle != "none" else "")


def quiet(data: Deferred) -> Deferred:
    """Turn off progress bars: points run in parallel, and their bars would mix."""
    try:
        return data.changed({"progress": False})
    except ValueError:
        return data  # these data show no progress


def compile_kernels(data: Sequence[Deferred]) -> None:
    """Run a few samples in this process, so that workers find the compiled kernels on disk."""
    for each in data:
        sample_s = each.settings.get("sample_s") or 1e-6
        brief = {"duration_s": GLIMPSE_SAMPLES * sample_s, "warm_up_s": 0.0, "cache": None}
        try:
            each.changed({"sample_s": sample_s, **brief}).build()
        except ValueError:
            continue  # the point reports the reason when it is run
        return
