"""Operating points: one support for all, and a law run freely where no fit has been.

    python -m benchmarks.points family 100   # realizations for each noise level
    python -m benchmarks.points grid

`family`: a breathing mode in its simplest form, n_i' = -l n_i + k n_i n_n, n_n' = g - k n_i n_n
(the thesis's Eq. 25, made dimensionless), whose coefficients follow voltage and mass flow by a
known law, with records of about one pulse. Percentage of realizations in which the supports of all
equations are right: of one search over all points, of one regression with shared coefficients, and
of every point alone; then the errors of the coefficients.
`grid`: the package's own discharge at 290 to 370 V and 4 to 5.5 mg/s, five by five, 6 ms each,
densities averaged over the channel. The laws of three given structures, and of one that is searched
under roles: each point left out in turn, next to interpolation without a model, and points between.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product

import numpy as np
import pandas as pd

import ep2sindy as ep
from ep2sindy.runtime.parallel import Loky, Workers

# The thesis's six operating points (Table IV): V and mg/s.
PARAMETERS: Mapping[str, Mapping[str, float]] = {
    f"{V_D}V_{mdot_mgs}mgs": {"V_D": float(V_D), "mdot_mgs": float(mdot_mgs)}
    for V_D, mdot_mgs in ((200, 5), (300, 2), (300, 4), (300, 5), (300, 6), (400, 5))
}
LAW = ep.polynomial(["V_D", "mdot_mgs"], degree=1)
# State -> term -> coefficients of 1, V_D and mdot_mgs in the law.
TRUTH: Mapping[str, Mapping[str, Sequence[float]]] = {
    "n_i": {"n_i": (-0.4, -0.002, 0.0), "n_i*n_n": (1.0, 0.002, -0.05)},
    "n_n": {"1": (0.0, 0.0, 0.015), "n_i*n_n": (-1.0, -0.002, 0.05)},
}
LIBRARY = ep.polynomial(list(TRUTH), degree=3)
DURATION_S, RATE_HZ = 15.0, 10.0  # small oscillations last 18 to 30 s
# Where records start, drawn evenly between: away from the steady state, which would show little.
INITIAL = ((0.1, 0.4), (0.5, 1.6))
NOISES = (0.0, 0.05, 0.1)
ERRORS = ("error_alone", "error_law")
# Half-width: a tenth of a record, since the automatic one can leave fewer windows than terms in a
# record this short. Five candidates of each size: the rows are weighted under the whole library,
# where a wrong support can lead its size by a hair; the criterion weighs them again under the
# candidate.
METHOD = ep.Regression(
    ep.WeightedWeak(
        ep.Weak(
            test_functions=ep.regression.Bumps(half_width_s=1.5),
            split=ep.regression.RandomSplit(0.0),
        )
    ),
    ep.BestSubset(n_best=5),
    selection=ep.EBIC(),
    depth=5,
)


def system_at(parameters: Mapping[str, float]) -> ep.systems.System:
    """The member of the family at one operating point."""
    law = LAW.evaluate(np.array([parameters[name] for name in LAW.variables]))
    equations = {
        state: {term: float(law @ coef) for term, coef in terms.items()}
        for state, terms in TRUTH.items()
    }
    coef = ep.model.coef_matrix(LIBRARY, list(equations.values()))
    model = ep.SparseModel(LIBRARY, list(equations), coef, provenance={"truth": "breathing family"})
    return ep.systems.System(
        "breathing family", model, np.mean(INITIAL, axis=0), DURATION_S, RATE_HZ
    )


def realization(noise: float, number: int, *, seed: int = 0) -> dict[str, list[ep.Trajectory]]:
    """One noisy record for each point, from a random start; noise levels share starts and pattern.

    noise: standard deviation of the white noise, in RMS of each state.
    """
    rng = np.random.default_rng([seed, number])
    starts = rng.uniform(*INITIAL, size=(len(PARAMETERS), len(TRUTH)))
    found = {}
    streams = rng.spawn(len(PARAMETERS))
    for (point, parameters), start, stream in zip(PARAMETERS.items(), starts, streams, strict=True):
        run = system_at(parameters).trajectory(initial=start, noise=noise, rng=stream)
        found[point] = [replace(run, parameters=parameters)]
    return found


def outcome(task: tuple[float, int]) -> dict[str, float]:
    """One realization searched at all points together, and at every point alone.

    together, pooled and one entry per point: 1 where the supports of all equations are right.
    error_alone, error_law: RMS relative error of the coefficients at all points, of each point's
    fit and by the true law, where together is right.
    """
    noise, number = task
    points = realization(noise, number)
    runs = [run for own in points.values() for run in own]
    found = ep.discover(runs, LIBRARY, METHOD, law=LAW)
    pooled = ep.discover([replace(run, parameters={}) for run in runs], LIBRARY, METHOD)
    row = {"noise": noise, "number": number, "together": _right(found), "pooled": _right(pooled)}
    row |= {p: _right(ep.discover(own, LIBRARY, METHOD)) for p, own in points.items()}
    return row | (_errors(found) if row["together"] else dict.fromkeys(ERRORS, np.nan))


def _right(found: ep.Discovery) -> float:
    return float(
        all(set(found.chosen[state].terms) == set(terms) for state, terms in TRUTH.items())
    )


def _errors(found: ep.Discovery) -> dict[str, float]:
    assert found.law is not None
    errors: dict[str, list[float]] = {name: [] for name in ERRORS}
    for point, own in zip(PARAMETERS.values(), found.points.values(), strict=True):
        truth = system_at(point).model.coef
        by_law = found.law.at(extrapolate=False, **point)
        for name, model in zip(ERRORS, (own.model, by_law), strict=True):
            errors[name] += (model.coef[truth != 0.0] / truth[truth != 0.0] - 1.0).tolist()
    return {name: float(np.sqrt(np.mean(np.square(each)))) for name, each in errors.items()}


def family(n_realizations: int) -> None:
    tasks = list(product(NOISES, range(n_realizations)))
    rows = pd.DataFrame([row for _, row in Loky().run(outcome, tasks)])
    print(f"right supports, % of {n_realizations} realizations")
    print((100.0 * rows.groupby("noise")[["together", "pooled", *PARAMETERS]].mean()).to_string())
    print("median relative error of the coefficients where the support of all points is right")
    print(rows.groupby("noise")[list(ERRORS)].median())


STATES, NAMES = ["n_i", "n_n"], ["V_D_V", "mdot_mg_s"]
CUBIC = ep.polynomial(STATES, degree=3)
INFLOW = {"mdot_mg_s": 4.58e22}  # mdot / (m_Xe A L) with A = 40.06 cm^2 and L = 25 mm
FED = CUBIC.known({"n_n": {"1": INFLOW}})
LEAVING = {f"n_i: {term} == -1 * n_n: {term}" for term in ("n_i*n_n", "n_i^2*n_n")}
EXCHANGED = {
    "n_i": ["n_i", "n_n", "n_i*n_n", "n_i^2*n_n"],
    "n_n": ["1", "n_i", "n_n", "n_i*n_n", "n_i^2*n_n"],
}
GIVEN = {
    "free": CUBIC.only({"n_i": ["n_i", "n_n", "n_i^2", "n_i*n_n"], "n_n": ["1", "n_i*n_n"]}),
    "leaving": FED.relate(*sorted(LEAVING)).only(EXCHANGED),
    "conserving": FED.relate(*sorted(LEAVING), "n_i: n_n == -1 * n_n: n_n").only(EXCHANGED),
}
ROLES = ep.Roles(
    exchange=[("n_n", "n_i")], outflow={"n_i": "free", "n_n": "free"}, inflow={"n_n": INFLOW},
    nonnegative=True,
)  # fmt: skip
ROWS = ep.Differential(split=ep.regression.RandomSplit(0.0))
SEARCH = ep.Regression(
    ROWS, ep.BestSubset(6, n_best=2000), ep.FreeRunScore(window_periods=4, n_confirmed=16), depth=16
)
WINDOWS = ep.refinement.RefinementSettings(n_windows=20, periods=2.0)
VOLTAGES, FLOWS = (290.0, 310.0, 330.0, 350.0, 370.0), (4.0, 4.375, 4.75, 5.125, 5.5)
N_BETWEEN = 20
DEFAULT_SPEED = ep.thruster.OPERATING_POINTS[3].neutral_speed


def recorded(point: tuple[float, float]) -> ep.Trajectory:
    voltage, flow = point
    field = ep.thruster.simulate(
        ep.thruster.Thruster(),
        ep.thruster.OperatingPoint(voltage, flow, neutral_speed=DEFAULT_SPEED),
        cache=True, duration_s=6e-3, progress=False,
    )  # fmt: skip
    run = ep.zone_average(field, ep.Zone(z="channel"), states=STATES)
    return replace(run, parameters=dict(zip(NAMES, point, strict=True)))


def all_recorded(points: Sequence[tuple[float, float]], workers: Workers) -> list[ep.Trajectory]:
    return [run for _, run in sorted(workers.run(recorded, points), key=lambda each: each[0])]


def grid() -> None:
    workers = Loky()
    runs = all_recorded(list(product(VOLTAGES, FLOWS)), workers)
    drawn = np.random.default_rng(1).uniform(
        (VOLTAGES[0], FLOWS[0]), (VOLTAGES[-1], FLOWS[-1]), (N_BETWEEN, 2)
    )
    between = all_recorded([(round(v, 1), round(m, 2)) for v, m in drawn], workers)
    law = ep.discovery.LawSearch("auto", WINDOWS)
    asked = {name: (library, ep.Regression(ROWS), law) for name, library in GIVEN.items()}
    asked["roles"] = (CUBIC.with_roles(ROLES), SEARCH, ep.discovery.LawSearch())
    for name, (library, method, search) in asked.items():
        found = ep.discover(runs, library, method, law=search, workers=workers)
        choice = found.law_choice
        assert choice is not None
        at = [
            ep.evaluate(choice.law.at(extrapolate=False, **run.parameters), run) for run in between
        ]
        print(f"{name}: {choice.choice.name}, {choice.choice.n_numbers} numbers. {choice.text}")
        print(f"    at {N_BETWEEN} points between, it holds at {sum(run.holds for run in at)}")
        ratios = [[1.0 + run.f_error, *run.amplitude_ratio.values()] for run in at]
        off = np.abs(np.array(ratios) - 1.0)
        f, amplitude = np.median(off[:, 0]), np.median(off[:, 1:].max(axis=1))
        print(f"    and errs by {f:.3%} in frequency and {amplitude:.1%} in amplitude", flush=True)


def main() -> None:
    what = sys.argv[1] if len(sys.argv) > 1 else "family"
    if what == "grid":
        grid()
    else:
        family(int(sys.argv[2]) if len(sys.argv) > 2 else 100)


if __name__ == "__main__":
    main()
