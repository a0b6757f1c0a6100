"""Refinement against trajectories: multiple shooting against the plain ways, in CPU time.

Synthetic breathing data, 12001 samples every 1.5 us, 2 % noise and 3 % lines at 100-180 kHz, and
a model driven by two inputs. 30 windows of 100 samples that start at the data, one thread: the
CPU time until the loss is within 1e-4 of its optimum; ours is that of a whole call, from windows
to covariance, with a tolerance just enough for that. The simplex is the thesis's, with scipy's
odeint window by window, on a right-hand side written by hand for this model. Prints the table of
docs/refinement.md.

    python -m benchmarks.refine
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from scipy.integrate import odeint, solve_ivp
from scipy.optimize import minimize
from threadpoolctl import threadpool_limits

from benchmarks.timing import cpu_s
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import named_terms
from ep2sindy.model.model import SparseModel, coef_matrix
from ep2sindy.refinement.methods.gradient_descent import GradientDescent
from ep2sindy.refinement.methods.multiple_shooting import MultipleShooting
from ep2sindy.refinement.problem import Iteration, RefinementProblem
from ep2sindy.refinement.refine import refine
from ep2sindy.refinement.windows import WindowBatch, cut_windows
from tests.single_shooting import SingleShooting

DT_S, N_SAMPLES, N_WINDOWS, WINDOW = 1.5e-6, 12001, 30, 100
CLOSE = 1e-4  # of the optimal loss
STATES = ("n_i", "n_n")
SOLVER = {"method": "DOP853", "rtol": 1e-9, "atol": 1e-11}


@dataclass(frozen=True)
class Case:
    """Data, and the model to start from."""

    name: str
    data: Trajectory
    start: SparseModel


def predator_prey(n_i: dict[str, float], n_n: dict[str, float]) -> SparseModel:
    library = named_terms(STATES, ["n_i", "n_n", "n_i*n_n"])
    return SparseModel(library, STATES, coef_matrix(library, [n_i, n_n]))


TRUTH = predator_prey({"n_i": -1.64e5, "n_i*n_n": 4.66e-14}, {"n_n": 4.39e4, "n_i*n_n": -4.66e-14})
START = predator_prey({"n_i": -1.45e5, "n_i*n_n": 4.12e-14}, {"n_n": 4.58e4, "n_i*n_n": -4.89e-14})


def contaminated(states: np.ndarray, t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """2 % white noise, and 3 % lines between 100 and 180 kHz, of each state's std."""
    std = states.std(axis=0)
    frequency_Hz = rng.uniform(1e5, 1.8e5, (6, 2))
    phase = rng.uniform(0.0, 2.0 * np.pi, (6, 2))
    lines = np.sin(2.0 * np.pi * frequency_Hz * t[:, None, None] + phase).sum(axis=1) / np.sqrt(3)
    return states + std * (0.02 * rng.standard_normal(states.shape) + 0.03 * lines)


def breathing_states(n_samples: int) -> tuple[np.ndarray, np.ndarray]:
    t = np.arange(n_samples) * DT_S
    scale = np.array([4e17, 3.5e18])
    solution = solve_ivp(
        lambda _, y: TRUTH.derivative(y * scale, np.empty(0)) / scale,
        (0.0, t[-1]),
        [1.0, 1.0],
        t_eval=t,
        **SOLVER,
    )
    return t, solution.y.T * scale


def breathing(rng: np.random.Generator) -> Case:
    t, states = breathing_states(N_SAMPLES)
    return Case("predator-prey", Trajectory(t, contaminated(states, t, rng), STATES), START)


def forced(rng: np.random.Generator) -> Case:
    """n_i' = -41.2 n_i u + 0.82 n_i n_n R, n_n' = 1.83e23 - 0.77 n_i n_n R."""
    t = np.arange(N_SAMPLES) * DT_S
    variables = [*STATES, "u", "R"]
    library = named_terms(variables, ["1", "n_i*u", "n_i*n_n*R"])
    equations: list[Mapping[str, float]] = [
        {"n_i*u": -41.2, "n_i*n_n*R": 0.82},
        {"1": 1.83e23, "n_i*n_n*R": -0.77},
    ]
    truth = SparseModel(library, STATES, coef_matrix(library, equations))

    def inputs(now: np.ndarray | float) -> np.ndarray:
        turn = 2.0 * np.pi * np.asarray(now)
        u = 4.0e3 * (1.0 + 0.1 * np.sin(9.0e3 * turn))
        R = 5.7e-14 * (1.0 + 0.15 * np.sin(1.3e4 * turn + 1.0) + 0.05 * np.sin(2.9e4 * turn))
        return np.stack([u, R], axis=-1)

    scale = np.array([1.2e18, 3.5e18])
    solution = solve_ivp(
        lambda now, y: truth.derivative(y * scale, inputs(now)) / scale,
        (0.0, t[-1]),
        [0.5, 1.0],
        t_eval=t,
        **SOLVER,
    )
    states = contaminated(solution.y.T * scale, t, rng)
    start = replace(truth, coef=truth.coef * np.array([[1.0, 0.95], [0.9, 1.0], [1.12, 1.08]]))
    return Case("forced", Trajectory(t, states, STATES, inputs(t), ["u", "R"]), start)


def problem(case: Case) -> RefinementProblem:
    batch = cut_windows([case.data], case.start, n_windows=N_WINDOWS, window=WINDOW, rng=0)
    return RefinementProblem.of([case.start], [batch], [None], free_start=False)


def by_hand(batch: WindowBatch, coef: np.ndarray, scaling: np.ndarray) -> np.ndarray:
    """Predator-prey trajectories by scipy's odeint on plain numbers."""
    a, b, c, d = (float(value) for value in coef * scaling)

    def rhs(x: np.ndarray, _: float) -> tuple[float, float]:
        n_i, n_n = float(x[0]), float(x[1])
        return a * n_i + b * n_i * n_n, c * n_n + d * n_i * n_n

    t = np.arange(batch.data.shape[1], dtype=np.float64)
    return np.stack([odeint(rhs, data[0], t) for data in batch.data])


def forced_by_hand(batch: WindowBatch, coef: np.ndarray, scaling: np.ndarray) -> np.ndarray:
    """The same for the forced model, its inputs from the cubics of every segment."""
    a, b, g, d = (float(value) for value in coef * scaling)

    def rhs(x: np.ndarray, t: float, cubics: list) -> tuple[float, float]:
        k = min(max(int(t), 0), len(cubics) - 1)
        s = t - k
        (u3, R3), (u2, R2), (u1, R1), (u0, R0) = cubics[k]
        u, R = ((u3 * s + u2) * s + u1) * s + u0, ((R3 * s + R2) * s + R1) * s + R0
        n_i, n_n = float(x[0]), float(x[1])
        burn = n_i * n_n * R
        return a * n_i * u + b * burn, g + d * burn

    t = np.arange(batch.data.shape[1], dtype=np.float64)
    paths = zip(batch.data, batch.inputs.tolist(), strict=True)
    return np.stack([odeint(rhs, data[0], t, args=(cubics,)) for data, cubics in paths])


def simplex_s(
    paths: Callable[[np.ndarray], np.ndarray], data: np.ndarray, *, n_free: int, goal: float
) -> float:
    """CPU time until Nelder-Mead first meets the goal."""
    begin = time.process_time()
    reached: list[float] = []

    def loss(scaling: np.ndarray) -> float:
        value = float(np.square(paths(scaling) - data).mean())
        if value <= goal and not reached:
            reached.append(time.process_time() - begin)
        return value

    def stop(_: np.ndarray) -> None:
        if reached:
            raise StopIteration

    options = {"xatol": 1e-9, "fatol": 0.0, "maxiter": 5000}
    minimize(loss, np.ones(n_free), method="Nelder-Mead", callback=stop, options=options)
    return reached[0] if reached else float("nan")


def descent_s(work: RefinementProblem, method: GradientDescent, *, goal: float) -> float:
    """CPU time until the step that met the goal was done: its loss is reported by the next."""
    times, losses = [time.process_time()], [np.inf]

    def observe(iteration: Iteration) -> None:
        times.append(time.process_time())
        losses.append(iteration.loss)

    method.fit(replace(work, observe=observe))
    below = [k for k, loss in enumerate(losses) if loss <= goal]
    return times[below[0] - 1] - times[0] if below else float("nan")


def ours(case: Case, method: MultipleShooting | SingleShooting) -> float:
    """Loss of the whole call."""
    found = refine(
        case.start,
        [case.data],
        n_windows=N_WINDOWS,
        window=WINDOW,
        method=method,
        free_start=False,
        n_reweights=0,
        seed=np.random.default_rng(0),
    )
    return found.loss


def compare(case: Case) -> None:
    brief, work = MultipleShooting(tolerance=1e-2), problem(case)
    goal = (1.0 + CLOSE) * ours(case, MultipleShooting(tolerance=1e-10))
    assert ours(case, brief) <= goal
    base = cpu_s(partial(ours, case, brief), n_runs=9)
    print(f"{case.name}: {N_WINDOWS} windows x {WINDOW} samples, to {CLOSE:g} of the optimum")
    print(f"  multiple shooting                      {base:9.4f} s")
    unit = work.equations[0].by_scaling.sum(axis=(0, 1))
    hand = by_hand if case.name == "predator-prey" else forced_by_hand
    paths = partial(hand, work.batches[0], unit)
    others = {
        "simplex, odeint, by hand": simplex_s(paths, work.data[0], n_free=work.n_free, goal=goal),
        "gradient descent (L-BFGS)": descent_s(work, GradientDescent(), goal=goal),
        "forward sensitivities, least_squares": cpu_s(
            partial(ours, case, SingleShooting()), n_runs=3
        ),
    }
    for name, value in others.items():
        print(f"  {name:<38} {value:9.4f} s, {value / base:.0f} times")


def main() -> None:
    torch.set_num_threads(1)
    with threadpool_limits(limits=1):
        compare(breathing(np.random.default_rng(0)))
        compare(forced(np.random.default_rng(2)))


if __name__ == "__main__":
    main()
