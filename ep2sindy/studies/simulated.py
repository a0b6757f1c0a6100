"""Simulations that a study takes: what they are, what is amiss with them, kernels for many."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from tempfile import TemporaryDirectory
from typing import Any

import xarray as xr

from ep2sindy.report.run import Run
from ep2sindy.studies.study import Deferred

MIN_SAMPLES = 200  # some periods of breathing at the usual step: less says nothing of it
GLIMPSE_SAMPLES = 20
BALANCE_TOLERANCE = 1e-3  # of what enters; a record in float32 closes to 1e-4
BALANCES = {"mass_balance": "mass", "energy_balance": "energy"}
VERDICTS = {
    "diverged": "the simulation diverged: the end of its record is no physics",
    "steady": "the simulation is steady: there is no oscillation to learn from",
    "decaying": "the simulation's oscillation dies out: what is found describes a transient",
}


class DivergedError(ValueError):
    """A run that ended before there was anything to study."""


def is_simulation(attributes: Mapping[str, Any]) -> bool:
    """Whether they are those that a run of this package's simulators has."""
    return {"status", "I_d_mean", "I_d_std", "parameters"} <= set(attributes)


def check_recorded(field: xr.Dataset) -> None:
    """Raise DivergedError for a run that broke before it had recorded anything of use."""
    if is_simulation(field.attrs) and field.attrs["status"] == "diverged":
        n_samples = field.sizes["time"]
        if n_samples < MIN_SAMPLES:
            raise DivergedError(
                f"the simulation must record {MIN_SAMPLES} samples or more to be studied: it "
                f"diverged after {n_samples}; try shorter steps (++data.cfl=0.4), more cells, "
                "other parameters or another start; +exp=simulate shows what it did"
            )


def amiss(attributes: Mapping[str, Any]) -> list[str]:
    """Everything that whoever takes this simulation must know; none where all is well."""
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
    """What is amiss beside the status: rates beyond their table, balances that do not close."""
    found = []
    if (rates := attributes.get("rates", "covered")) != "covered":
        found.append(str(rates))
    for name, words in BALANCES.items():
        value = attributes.get(name, 1.0)
        if not abs(value - 1.0) <= BALANCE_TOLERANCE:  # NaN is amiss, too
            found.append(
                f"the simulation's {words} balance does not close: (out + stored)/in is {value:.4f}"
            )
    return found


def say_simulation(run: Run, attributes: Mapping[str, Any]) -> None:
    """One line on a simulation, and its warnings, for the screen, the page and the summary."""
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
    """`oscillating, strong cycle`; a status alone where there is no cycle."""
    cycle = attributes.get("cycle", "none")
    return attributes["status"] + (f", {cycle} cycle" if cycle != "none" else "")


def compile_kernels(data: Sequence[Deferred]) -> None:
    """A glimpse of a run in this process: workers then find the compiled kernels on disk."""
    with TemporaryDirectory() as folder:
        for each in data:
            sample_s = each.settings.get("sample_s") or 1e-6
            brief = {"duration_s": GLIMPSE_SAMPLES * sample_s, "warm_up_s": 0.0, "cache": folder}
            try:
                each.changed({"sample_s": sample_s, **brief}).build()
            except (ValueError, OSError):
                continue  # this point says why when its turn comes
            return
