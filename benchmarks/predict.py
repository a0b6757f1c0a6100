"""A law over a grid of operating points, every point left out in turn and run freely.

    python -m benchmarks.predict [--degree 2]

The package's own discharge at 250 to 400 V and 4 to 6 mg/s, five by five, 6 ms each after 2 ms of
warm-up; densities in the downstream zone; six coefficients of the structure below. First how
smooth the measured frequencies and amplitudes are: interpolated by as many functions themselves.
"""

import argparse
import time
from collections.abc import Sequence
from itertools import product

import numpy as np

import ep2sindy as ep
from ep2sindy.discovery.operating_fit import LeftOut, OperatingFit, left_out, operating_fit
from ep2sindy.discovery.operating_points import (
    OperatingRecord,
    branches_of,
    measured_left_out,
    point_text,
)

STRUCTURE = {"n_i": ["n_i", "n_n", "n_i*n_n"], "n_n": ["1", "n_i", "n_n"]}
LIBRARY = ep.polynomial(["n_i", "n_n"], degree=2)
ZONE = ep.Zone(z=(0.015, 0.025))
VOLTAGES, FLOWS = (250.0, 287.5, 325.0, 362.5, 400.0), (4.0, 4.5, 5.0, 5.5, 6.0)


def recorded(voltage: float, flow: float) -> OperatingRecord:
    field = ep.simulate_cached(
        ep.Thruster(),
        ep.OperatingPoint(voltage, flow),
        cache=".cache/simulations",
        duration_s=6e-3,
        progress=False,
    )
    run = ep.zone_average(field, ZONE, states=["n_i", "n_n"])
    return OperatingRecord.of({"V_D_V": voltage, "mdot_mg_s": flow}, run)


def line(name: str, found: Sequence[LeftOut]) -> str:
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


def judged(fit: OperatingFit, degree: int) -> None:
    functions = fit.functions(degree)
    f, amplitude = measured_left_out(fit.records, fit.basis(functions))
    print(
        f"the records' own, by as many functions: f {np.median(f):.2%}, 9 in 10 "
        f"{np.quantile(f, 0.9, method='higher'):.2%}; amplitude {np.median(amplitude):.1%}"
    )
    print(f"{fit.n_coefs} coefficients, {fit.n_coefs * len(functions)} numbers")
    print(line("weighted", left_out(fit, functions)), flush=True)
    law, found = fit.tied(functions)
    inside = left_out(fit, functions, start=law)
    print(f"tied: {found.status}, loss {found.loss.mean():.4f}")
    print(line("tied", inside))
    print(line("tied, enclosed only", [each for each in inside if each.inside]))
    for each in inside:
        r = each.run
        print(f"  {point_text(each.record.parameters)}: {r.verdict}, f {r.f_error:+.2%}")


def main() -> None:
    parser = argparse.ArgumentParser(description="laws of the operating point, left out in turn")
    parser.add_argument("--degree", type=int, default=2)
    degree = parser.parse_args().degree
    records = [recorded(*point) for point in product(VOLTAGES, FLOWS)]
    branch = branches_of(records)
    for record, number in zip(records, branch, strict=True):
        if number:
            print(f"on another cycle: {point_text(record.parameters)}")
    strong = [record for record, number in zip(records, branch, strict=True) if not number]
    start = time.perf_counter()
    fit = operating_fit(strong, LIBRARY, STRUCTURE)
    print(f"{len(strong)} points refined in {time.perf_counter() - start:.0f} s")
    judged(fit, degree)
    print(f"{time.perf_counter() - start:.0f} s in all")


if __name__ == "__main__":
    main()
