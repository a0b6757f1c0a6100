"""A law over a grid of operating points, every point left out in turn and run freely.

    python -m benchmarks.predict [--degree 2]

The package's own discharge at 290 to 370 V and 4 to 5.5 mg/s, five by five, 6 ms each after 2 ms
of warm-up, densities averaged over the channel. First how smooth the measured frequencies and
amplitudes are: interpolated by as many functions themselves. Then the models of
conf/exp/predict.yaml and two that leave out what these know; the chosen one refined over all
records, also at points drawn between; the downstream zone for comparison; a map that reaches to
where nothing oscillates; three by three points; a wider grid that holds two cycles; and the strong
one of two cycles.
"""

import argparse
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import yaml

import ep2sindy as ep
from ep2sindy.model.comparison import Verdict
from ep2sindy.model.free_run import FreeRun
from ep2sindy.operating.fit import LeaveOneOut, OperatingFit, leave_one_out, operating_fit
from ep2sindy.operating.law import OperatingLaw, make_basis
from ep2sindy.operating.map import Fate, law_map
from ep2sindy.operating.records import (
    OperatingRecord,
    branches_of,
    interpolation_errors,
    point_label,
    read_points,
)

CONFIG = Path(__file__).parents[1] / "conf" / "exp" / "predict.yaml"
MODELS: dict[str, Any] = yaml.safe_load(CONFIG.read_text("utf-8"))["models"]
BEST, OF_FEW = "leaving", "conserving"  # the study's choice, here and of a few points
MODELS["leaving, inflow free"] = {**MODELS[BEST], "known": {}}
MODELS["leaving, all free"] = {"terms": MODELS[BEST]["terms"]}
IONIZED = ["n_i^2*n_n", "n_i*n_n^2"]  # in the law of docs/living.md
for name, others in {
    "law": ["n_i", "n_i^2"],
    "law, seed for n_i^2": ["n_i", "n_n"],
    "law and seed": ["n_i", "n_n", "n_i^2"],
}.items():
    MODELS[name] = {
        "terms": {"n_i": [*others, *IONIZED], "n_n": ["1", "n_n", *IONIZED]},
        "known": MODELS[BEST]["known"],
        "relations": [f"n_i: {term} == -1 * n_n: {term}" for term in IONIZED],
    }
DOWNSTREAM = {"terms": {"n_i": ["n_i", "n_n", "n_i*n_n"], "n_n": ["1", "n_i", "n_n"]}}
LIBRARY = ep.polynomial(["n_i", "n_n"], degree=3)
VOLTAGES, FLOWS = (290.0, 310.0, 330.0, 350.0, 370.0), (4.0, 4.375, 4.75, 5.125, 5.5)
N_BETWEEN = 20

EDGE = (  # to where it is quiet
    *product((200.0, 225.0, 250.0), (2.5, 3.0, 4.0)),
    *product((300.0, 340.0, 380.0), (2.5, 3.0, 3.5)),
)
NINE = tuple(product((300.0, 330.0, 360.0), (4.0, 4.75, 5.5)))
WIDE = tuple(product((250.0, 287.5, 325.0, 362.5, 400.0), (4.0, 4.5, 5.0, 5.5, 6.0)))
ALONG = (4.0, 4.25, 4.5, 4.75, 5.0, 5.25, 5.5, 5.75, 6.0)  # of the two cycles, at 300 V
DEFAULT_SPEED = ep.thruster.OPERATING_POINTS[3].neutral_speed  # 280 m/s with TWO_CYCLES
TWO_CYCLES = ep.thruster.Thruster(  # conf/thruster/two_cycles.yaml
    transport=ep.thruster.AnomalousTransport(c_channel=1 / 300, c_plume=1 / 80, transition=3e-3),
    wall=ep.thruster.SheathWall(), conduction_factor=4.66, series_resistance=1.0,
)  # fmt: skip


@cache
def averaged(
    voltage: float, flow: float, thruster: ep.thruster.Thruster | None
) -> dict[str, ep.Trajectory] | None:
    """Averages over both zones; None where the simulation does not breathe."""
    field = ep.thruster.simulate(
        thruster or ep.thruster.Thruster(),
        ep.thruster.OperatingPoint(
            voltage, flow, neutral_speed=280.0 if thruster else DEFAULT_SPEED
        ),
        cache=True,
        duration_s=6e-3,
        progress=False,
    )
    if field.attrs["status"] != "oscillating":
        return None
    return {
        zone: ep.zone_average(field, ep.Zone(z=zone), states=["n_i", "n_n"])
        for zone in ("channel", "downstream")
    }


def recorded(
    voltage: float,
    flow: float,
    *,
    zone: str = "channel",
    thruster: ep.thruster.Thruster | None = None,
) -> OperatingRecord | None:
    """None where the simulation does not breathe."""
    runs = averaged(float(voltage), float(flow), thruster)
    if runs is None:
        return None
    return OperatingRecord.of({"V_D_V": voltage, "mdot_mg_s": flow}, runs[zone])


def one_branch(records: Sequence[OperatingRecord | None]) -> list[OperatingRecord]:
    """The stronger cycle; prints what is on the other."""
    known = [record for record in records if record is not None]
    branch = branches_of(known)
    for record, number in zip(known, branch, strict=True):
        if number:
            print(f"on another cycle: {record.label}")
    return [record for record, number in zip(known, branch, strict=True) if not number]


def line(name: str, runs: Sequence[FreeRun]) -> str:
    f = np.array([abs(run.f_error) for run in runs])
    f[np.isnan(f)] = np.inf
    amplitude = [max(abs(v - 1) for v in run.amplitude_ratio.values()) for run in runs]
    waveform = [max(run.waveform_error.values()) for run in runs]
    gone = sum(run.rollout.diverged for run in runs)
    lives = sum(run.verdict is Verdict.LIVES for run in runs)
    return (
        f"{name:<22} {lives} of {len(runs)} live, diverging {gone}; f {np.median(f):.2%}, 9 in 10 "
        f"{np.quantile(f, 0.9, method='higher'):.2%}, at most {f.max():.2%}; amplitude "
        f"{np.nanmedian(amplitude):.1%}; waveform {np.nanmedian(waveform):.3f}"
    )


def runs_of(found: Sequence[LeaveOneOut], *, enclosed: bool = False) -> list[FreeRun]:
    return [each.run for each in found if each.inside or not enclosed]


def fitted(records: Sequence[OperatingRecord], model: Mapping[str, Any]) -> OperatingFit:
    return operating_fit(
        records,
        LIBRARY,
        model["terms"],
        relations=model.get("relations", ()),
        known=model.get("known", {}),
    )


def smoothness(records: Sequence[OperatingRecord], degree: int) -> None:
    functions = ep.polynomial(list(records[0].parameters), degree=degree)
    basis = make_basis(functions, read_points(records))
    f, amplitude = interpolation_errors(records, basis)
    print(
        f"the records' own, by as many functions: f {np.median(f):.2%}, 9 in 10 "
        f"{np.quantile(f, 0.9, method='higher'):.2%}; amplitude {np.median(amplitude):.1%}"
    )


def tried(records: Sequence[OperatingRecord], degree: int) -> None:
    """Every model by laws through separate refinements; the chosen one by linear laws, too."""
    for name, model in MODELS.items():
        fit = fitted(records, model)
        functions = fit.functions(degree)
        print(f"{name}: {fit.n_free} coefficients, {fit.n_free * len(functions)} numbers")
        pairs = zip(fit.fits, records, strict=True)
        print(line("  refined alone", [ep.free_run(f.model, r.from_slowest) for f, r in pairs]))
        print(line("  left out", runs_of(leave_one_out(fit, functions))), flush=True)
        if name == BEST:
            print(line("  linear laws", runs_of(leave_one_out(fit, fit.functions(1)))), flush=True)


def judged(fit: OperatingFit, degree: int) -> OperatingLaw:
    functions = fit.functions(degree)
    smoothness(fit.records, degree)
    print(f"{fit.n_free} coefficients, {fit.n_free * len(functions)} numbers")
    print(line("weighted", runs_of(leave_one_out(fit, functions))), flush=True)
    law, found = fit.refine_law(functions)
    left_out = leave_one_out(fit, functions, start=law)
    print(f"refined: {found.status}, loss {found.loss.mean():.4f}")
    print(line("refined", runs_of(left_out)))
    print(line("refined, enclosed only", runs_of(left_out, enclosed=True)))
    for each in left_out:
        if each.run.verdict is not Verdict.LIVES:
            print(f"  {each.record.label}: {each.run.verdict}, f {each.run.f_error:+.2%}")
    return law


def between(law: OperatingLaw, n: int, *, zone: str = "channel") -> None:
    """Free runs of the law at points inside the grid that no fit has seen, drawn at random."""
    rng = np.random.default_rng(1)
    low, high = (VOLTAGES[0], FLOWS[0]), (VOLTAGES[-1], FLOWS[-1])
    points = [(round(v, 1), round(m, 2)) for v, m in rng.uniform(low, high, (n, 2))]
    drawn = [recorded(*point, zone=zone) for point in points]
    records = [record for record in drawn if record is not None]
    runs = [ep.free_run(law.model_at(record.parameters), record.run) for record in records]
    print(line(f"between, {zone}", runs), flush=True)


def mapped(strong: Sequence[OperatingRecord], quiet: Sequence[Mapping[str, float]]) -> None:
    """Whether a law of all that oscillates says where nothing does."""
    fit = fitted(strong, MODELS[BEST])
    law, found = fit.refine_law(fit.functions(2))
    points = [*quiet, *(record.parameters for record in strong)]
    right = 0
    for k, point in enumerate(law_map(law, strong, points)):
        right += (agrees := (point.fate is Fate.OSCILLATES) == (k >= len(quiet)))
        if k < len(quiet) or not agrees:
            state = "quiet" if k < len(quiet) else "oscillates"
            print(f"  {point_label(point.parameters)}: {state}; the model {point.fate}")
    print(f"map, {len(strong)} points fitted ({found.status}): right at {right} of {len(points)}")


def main() -> None:
    parser = argparse.ArgumentParser(description="laws of the operating point, left out in turn")
    parser.add_argument("--degree", type=int, default=2)
    degree = parser.parse_args().degree
    start = time.perf_counter()
    grid = tuple(product(VOLTAGES, FLOWS))
    strong = one_branch([recorded(*point) for point in grid])
    tried(strong, degree)
    print(f"{BEST}:")
    between(judged(fitted(strong, MODELS[BEST]), degree), N_BETWEEN)
    print(f"{time.perf_counter() - start:.0f} s\ndownstream, free:", flush=True)
    downstream = one_branch([recorded(*point, zone="downstream") for point in grid])
    between(judged(fitted(downstream, DOWNSTREAM), degree), N_BETWEEN, zone="downstream")
    edge = {point: recorded(*point) for point in EDGE}
    breathing = [record for record in edge.values() if record is not None]
    quiet = [{"V_D_V": v, "mdot_mg_s": m} for (v, m), record in edge.items() if record is None]
    mapped(one_branch([*strong, *breathing]), quiet)
    for title, points, name in (("nine", NINE, OF_FEW), ("250 to 400 V, 4 to 6 mg/s", WIDE, BEST)):
        print(f"{time.perf_counter() - start:.0f} s\n{title}:", flush=True)
        judged(fitted(one_branch([recorded(*point) for point in points]), MODELS[name]), degree)
    print(f"{time.perf_counter() - start:.0f} s\ntwo cycles, 300 V:", flush=True)
    both = map(partial(recorded, thruster=TWO_CYCLES), (300.0,) * len(ALONG), ALONG)
    along = [replace(r, parameters={"mdot_mg_s": r.parameters["mdot_mg_s"]}) for r in both if r]
    judged(fitted(one_branch(along), MODELS[OF_FEW]), degree)
    print(f"{time.perf_counter() - start:.0f} s in all")


if __name__ == "__main__":
    main()
