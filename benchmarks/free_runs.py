"""Free runs by compiled steps, and by SciPy's: CPU time, and how far apart they end.

python -m benchmarks.free_runs

Both take the same steps to rounding. Where rounding shifts a step, a run changes by as much as its
tolerance leaves: the last column says how far SciPy's own run is from one of a tolerance of 1e-12.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

import ep2sindy as ep
from benchmarks.timing import cpu_s
from ep2sindy.model.inputs import Curve, curve_through
from ep2sindy.model.solve import Driven, Integration, solve_stages
from ep2sindy.model.vector_field import VectorField

PERIODS, PER_PERIOD = 10, 60
# Each system with its period in its own unit of time.
SYSTEMS = {
    "Lotka-Volterra": (ep.lotka_volterra(), 14.5),
    "van der Pol": (ep.systems.van_der_pol(), 7.63),
    "damped oscillator": (ep.systems.damped_oscillator(zeta=0.01, omega=1.0), 6.28),
}


def run(rates: Callable, t: np.ndarray, y: np.ndarray, rtol: float) -> Integration:
    """Without a bound or an edge."""
    return solve_stages(rates, t, y, rtol=rtol, limit_s=300.0)


def equations(system: ep.systems.System, drive: Curve) -> Driven:
    """Of a system; a driven one has its first input in its first state."""
    field, n = system.model.field, len(system.model.states)
    if drive.pieces.shape[2]:
        library = field.library.over([*system.model.states, "u"])
        library = library + ep.named_terms(library.variables, ["u"])
        field = VectorField(library, np.concatenate([field.coef, 0.1 * np.eye(1, n)]))
    return Driven(field, drive)


def row(name: str, rates: Driven, t: np.ndarray, y: np.ndarray) -> str:
    """Of one system: both times, their ratio, and distances in standard deviations."""

    def by_scipy(at: float, state: np.ndarray) -> np.ndarray:
        return rates(at, state)

    ours, theirs, exact = (
        run(how, t, y, rtol).y for how, rtol in ((rates, 1e-8), (by_scipy, 1e-8), (rates, 1e-12))
    )
    ours_s = cpu_s(partial(run, rates, t, y, 1e-8), n_runs=20)
    theirs_s = cpu_s(partial(run, by_scipy, t, y, 1e-8), n_runs=3)
    spread = exact.std(axis=0)
    apart, off = (float((np.abs(theirs - x) / spread).max()) for x in (ours, exact))
    times = f"{1e3 * ours_s:8.2f} {1e3 * theirs_s:8.1f} {theirs_s / ours_s:6.0f}"
    return f"{name:34} {times} {apart:10.1e} {off:10.1e}"


def main() -> None:
    print(f"{PERIODS} periods, {PER_PERIOD} samples each; CPU ms, distances in standard deviations")
    print(f"{'':34} {'ours':>8} {'SciPy':>8} {'ratio':>6} {'apart':>10} {'tolerance':>10}")
    for name, (system, period) in SYSTEMS.items():
        t = np.linspace(0.0, PERIODS * period, PERIODS * PER_PERIOD + 1)
        y = np.array(system.initial, dtype=np.float64)
        nothing = curve_through(t, np.empty((len(t), 0)), [])
        print(row(name, equations(system, nothing), t, y))
        if name == "Lotka-Volterra":
            continue  # which noise drives out of its domain
        noise = np.random.default_rng(0).standard_normal((len(t), 1))
        drive = curve_through(t, noise, ["smooth"])
        print(row(f"{name}, driven by noise", equations(system, drive), t, y))


if __name__ == "__main__":
    main()
