"""Refinement of four states and more, from starts that are off and models that are incomplete.

Coupled oscillators, coupled predators and prey, and Lorenz 96, 1000 samples with 2 % noise. The
rows `all terms` start from the true terms with coefficients that are off by up to 40 %. The rows
`hidden` see only some of the states: their models hold 40 % of the quadratic terms of these, drawn
at random, with coefficients by least squares on the derivative, off by up to 30 %. No such model
is right, and many run away over a window of one and a half periods.

    python -m benchmarks.many_states
"""

import time
import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

from benchmarks import known_systems
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import polynomial
from ep2sindy.model.model import SparseModel
from ep2sindy.refinement.problem import RefinementSettings
from ep2sindy.refinement.refine import refine
from tests.models import model_of

N_SAMPLES, N_STARTS, NOISE, SETTLED_S = 1000, 6, 0.02, 20.0


@dataclass(frozen=True)
class Case:
    """A system, the states that are seen, and the time step in s."""

    name: str
    truth: SparseModel
    initial: Sequence[float]
    dt_s: float
    seen: Sequence[str]


def oscillators(n: int) -> SparseModel:
    """Van der Pol oscillators of different frequency, each pulled by all others."""
    equations = {}
    for k in range(n):
        x, v = f"x{k}", f"v{k}"
        own = {v: 1.0, f"{x}^2*{v}": -1.0, x: -1.0 - 0.6 * k}
        equations[x] = {v: 1.0}
        equations[v] = own | {f"x{j}": 0.2 for j in range(n) if j != k}
    return model_of(equations)


def predators(n: int) -> SparseModel:
    """Pairs of prey and predator; the prey of one pair move to the next."""
    equations = {}
    for k in range(n):
        prey, other, predator = f"p{k}", f"p{(k + 1) % n}", f"q{k}"
        met = f"{prey}*{predator}"
        equations[prey] = {prey: 1.0 + 0.2 * k, other: 0.05, met: -0.5}
        equations[predator] = {predator: -0.8 - 0.1 * k, met: 0.3}
    return model_of(equations)


def lorenz_96(n: int) -> SparseModel:
    return model_of(known_systems.lorenz_96(n))


def cases() -> list[Case]:
    four, six = [2.0, 0.0, 1.0, 1.0], [2.0, 0.0, 1.0, 1.0, -1.0, 0.5]
    waves = [4.3, 3.1, 4.9, 4.4, 3.6, 4.0]
    systems = [
        ("oscillators", oscillators(2), four, 0.08),
        ("oscillators", oscillators(3), six, 0.08),
        ("predators", predators(2), [2.0, 1.0, 1.5, 1.0], 0.08),
        ("predators", predators(3), [2.0, 1.0, 1.5, 1.0, 2.0, 1.2], 0.08),
        ("Lorenz 96", lorenz_96(5), waves[:5], 0.02),
    ]
    whole = [Case(name, model, x, dt, model.states) for name, model, x, dt in systems]
    parts = [
        ("oscillators", oscillators(3), six, 0.24, 4),
        ("predators", predators(3), [2.0, 1.0, 1.5, 1.0, 2.0, 1.2], 0.24, 4),
        ("Lorenz 96", lorenz_96(6), waves, 0.06, 4),
    ]
    return [*whole, *(Case(name, m, x, dt, m.states[:n]) for name, m, x, dt, n in parts)]


def record(case: Case) -> Trajectory:
    """The states that are seen, after a transient, with noise."""
    t = case.dt_s * np.arange(N_SAMPLES)
    solution = solve_ivp(
        lambda _, x: case.truth.derivative(x, np.empty(0)), (0.0, SETTLED_S + t[-1]),
        case.initial, t_eval=SETTLED_S + t, rtol=1e-9, atol=1e-10,
    )  # fmt: skip
    columns = [case.truth.states.index(state) for state in case.seen]
    states = solution.y.T[:, columns]
    noise = np.random.default_rng(5).standard_normal(states.shape)
    return Trajectory(t, states + NOISE * states.std(axis=0) * noise, tuple(case.seen))


def starts(case: Case, run: Trajectory) -> list[SparseModel]:
    """Models to start from: the truth, off, or random terms by least squares, off."""
    rng = np.random.default_rng(1)
    if len(case.seen) == len(case.truth.states):
        shape = (N_STARTS, *case.truth.coef.shape)
        off = 1.0 + 0.4 * rng.uniform(-1.0, 1.0, shape)
        library, states = case.truth.library, case.truth.states
        return [SparseModel(library, states, case.truth.coef * each) for each in off]
    library = polynomial(case.seen, degree=2)
    theta, rates = library.evaluate(run.states), CubicSpline(run.t, run.states)(run.t, 1)
    found = []
    for _ in range(N_STARTS):
        coef = np.zeros((len(library), len(case.seen)))
        for equation, rate in enumerate(rates.T):
            rows = rng.random(len(library)) < 0.4
            rows[1 + equation] = True
            coef[rows, equation] = np.linalg.lstsq(theta[:, rows], rate, rcond=None)[0]
        coef *= 1.0 + 0.3 * rng.uniform(-1.0, 1.0, coef.shape)
        found.append(SparseModel(library, tuple(case.seen), coef))
    return found


def main() -> None:
    for case in cases():
        run = record(case)
        models = starts(case, run)
        begin = time.process_time()
        settings = RefinementSettings(n_windows=20, n_reweights=0)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)
            found = refine(models, [[run]] * len(models), settings, seed=0)
        cpu_s = (time.process_time() - begin) / len(models)
        counts = Counter(str(each.status) for each in found)
        kind = "all terms" if len(case.seen) == len(case.truth.states) else "hidden"
        losses = " ".join(f"{loss:.2g}" for loss in sorted(each.loss for each in found))
        print(
            f"{case.name}, {len(case.seen)} states, {kind}: {dict(counts)}, {cpu_s:.2f} s each, "
            f"losses {losses}",
            flush=True,
        )


if __name__ == "__main__":
    main()
