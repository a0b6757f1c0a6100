"""A law over a grid of operating points, every point left out in turn and run freely.

    python -m benchmarks.predict [--degree 2]

The package's own discharge at 290 to 370 V and 4 to 5.5 mg/s, five by five, 6 ms each after 2 ms
of warm-up; densities in the downstream zone; six coefficients of the structure below. First how
smooth the measured frequencies and amplitudes are: interpolated by as many functions themselves.
Then the law of all 25 at points drawn between them, a map that reaches to where nothing
oscillates, and the strong one of two cycles. The grid is that of conf/exp/predict.yaml.
"""

import argparse
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product

import numpy as np

import ep2sindy as ep
from ep2sindy.model.comparison import Verdict
from ep2sindy.operating.fit import LeaveOneOut, OperatingFit, leave_one_out, operating_fit
from ep2sindy.operating.law import OperatingLaw
from ep2sindy.operating.map import Fate, law_map
from ep2sindy.operating.records import (
    OperatingRecord,
    branches_of,
    interpolation_errors,
    point_label,
)

STRUCTURE = {"n_i": ["n_i", "n_n", "n_i*n_n"], "n_n": ["1", "n_i", "n_n"]}
LIBRARY = ep.polynomial(["n_i", "n_n"], degree=2)
ZONE = ep.Zone(z=(0.015, 0.025))
VOLTAGES, FLOWS = (290.0, 310.0, 330.0, 350.0, 370.0), (4.0, 4.375, 4.75, 5.125, 5.5)
N_BETWEEN = 20

EDGE = (  # to where it is quiet
    *product((200.0, 225.0, 250.0), (2.5, 3.0, 4.0)),
    *product((300.0, 340.0, 380.0), (2.5, 3.0, 3.5)),
)
DEFAULT_SPEED = ep.thruster.OPERATING_POINTS[3].neutral_speed  # 280 m/s with TWO_CYCLES
TWO_CYCLES = ep.thruster.Thruster(  # conf/thruster/two_cycles.yaml
    transport=ep.thruster.AnomalousTransport(c_channel=1 / 300, c_plume=1 / 80, transition=3e-3),
    wall=ep.thruster.SheathWall(), conduction_factor=4.66, series_resistance=1.0,
)  # fmt: skip


def recorded(
    voltage: float, flow: float, thruster: ep.thruster.Thruster | None = None
) -> OperatingRecord | None:
    """None where the simulation does not breathe."""
    field = ep.thruster.simulate(
        thruster or ep.thruster.Thruster(),
        ep.thruster.OperatingPoint(
            float(voltage), float(flow), neutral_speed=280.0 if thruster else DEFAULT_SPEED
        ),
        cache=".cache/simulations",
        duration_s=6e-3,
        progress=False,
    )
    if field.attrs["status"] != "oscillating":
        return None
    run = ep.zone_average(field, ZONE, states=["n_i", "n_n"])
    return OperatingRecord.of({"V_D_V": voltage, "mdot_mg_s": flow}, run)


def one_branch(records: Sequence[OperatingRecord | None]) -> list[OperatingRecord]:
    """The stronger cycle; prints what is on the other."""
    known = [record for record in records if record is not None]
    branch = branches_of(known)
    for record, number in zip(known, branch, strict=True):
        if number:
            print(f"on another cycle: {record.label}")
    return [record for record, number in zip(known, branch, strict=True) if not number]


def line(name: str, found: Sequence[LeaveOneOut]) -> str:
    f = np.array([abs(each.run.f_error) for each in found])
    f[np.isnan(f)] = np.inf
    amplitude = [max(abs(v - 1) for v in e.run.amplitude_ratio.values()) for e in found]
    waveform = [max(e.run.waveform_error.values()) for e in found]
    gone = sum(each.run.rollout.diverged for each in found)
    return (
        f"{name:<22} f {np.median(f):.2%}, 9 in 10 {np.quantile(f, 0.9, method='higher'):.2%}; "
        f"diverging {gone} of {len(found)}; amplitude {np.nanmedian(amplitude):.1%}; "
        f"waveform {np.nanmedian(waveform):.3f}"
    )


def judged(fit: OperatingFit, degree: int) -> OperatingLaw:
    functions = fit.functions(degree)
    f, amplitude = interpolation_errors(fit.records, fit.basis(functions))
    print(
        f"the records' own, by as many functions: f {np.median(f):.2%}, 9 in 10 "
        f"{np.quantile(f, 0.9, method='higher'):.2%}; amplitude {np.median(amplitude):.1%}"
    )
    print(f"{fit.n_coefs} coefficients, {fit.n_coefs * len(functions)} numbers")
    print(line("weighted", leave_one_out(fit, functions)), flush=True)
    law, found = fit.tied(functions)
    inside = leave_one_out(fit, functions, start=law)
    print(f"tied: {found.status}, loss {found.loss.mean():.4f}")
    print(line("tied", inside))
    print(line("tied, enclosed only", [each for each in inside if each.inside]))
    for each in inside:
        r = each.run
        print(f"  {each.record.label}: {r.verdict}, f {r.f_error:+.2%}")
    return law


def between(law: OperatingLaw, n: int) -> None:
    """Free runs of the law at points inside the grid that no fit has seen, drawn at random."""
    rng = np.random.default_rng(0)
    low, high = (VOLTAGES[0], FLOWS[0]), (VOLTAGES[-1], FLOWS[-1])
    drawn = [recorded(round(v, 1), round(m, 2)) for v, m in rng.uniform(low, high, (n, 2))]
    records = [record for record in drawn if record is not None]
    runs = [ep.free_run(law.model_at(record.parameters), record.run) for record in records]
    f = [abs(run.f_error) for run in runs]
    amplitude = [max(abs(ratio - 1) for ratio in run.amplitude_ratio.values()) for run in runs]
    waveform = [max(run.waveform_error.values()) for run in runs]
    lives = sum(run.verdict is Verdict.LIVES for run in runs)
    print(
        f"between, of {len(runs)}: {lives} live; f {np.median(f):.2%}, at most {max(f):.2%}; "
        f"amplitude {np.median(amplitude):.1%}; waveform {np.median(waveform):.3f}",
        flush=True,
    )


def mapped(strong: Sequence[OperatingRecord], quiet: Sequence[Mapping[str, float]]) -> None:
    """Whether a law of all that oscillates says where nothing does."""
    fit = operating_fit(strong, LIBRARY, STRUCTURE)
    law, found = fit.tied(fit.functions(2))
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
    strong = one_branch([recorded(*point) for point in product(VOLTAGES, FLOWS)])
    law = judged(operating_fit(strong, LIBRARY, STRUCTURE), degree)
    between(law, N_BETWEEN)
    print(f"{time.perf_counter() - start:.0f} s", flush=True)
    edge = {point: recorded(*point) for point in EDGE}
    breathing = [record for record in edge.values() if record is not None]
    quiet = [{"V_D_V": v, "mdot_mg_s": m} for (v, m), record in edge.items() if record is None]
    mapped(one_branch([*strong, *breathing]), quiet)
    print(f"{time.perf_counter() - start:.0f} s in all")
    print("two cycles, 300 V:")
    both = [
        recorded(300.0, flow, TWO_CYCLES) for flow in (4, 4.25, 4.5, 4.75, 5, 5.25, 5.5, 5.75, 6)
    ]
    along = [replace(r, parameters={"mdot_mg_s": r.parameters["mdot_mg_s"]}) for r in both if r]
    judged(operating_fit(one_branch(along), LIBRARY, STRUCTURE), degree)


if __name__ == "__main__":
    main()
