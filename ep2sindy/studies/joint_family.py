"""A family of known systems at six operating points: is the right support found, and by what?

A breathing mode in its simplest form, n_i' = -l n_i + k n_i n_n, n_n' = g - k n_i n_n (the
thesis's Eq. 25, made dimensionless), whose coefficients follow the discharge voltage and the mass
flow by a known law. Records hold about one pulse, so that one point often does not suffice.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import pandas as pd

from ep2sindy.joint import JointDiscovery, discover_jointly
from ep2sindy.library import polynomial
from ep2sindy.model import SparseModel, coef_matrix
from ep2sindy.parallel import Workers
from ep2sindy.regression import Formulation
from ep2sindy.search import Search
from ep2sindy.selection import Selection
from ep2sindy.systems import System
from ep2sindy.tied import tied_fit
from ep2sindy.trajectory import Trajectory

# The thesis's six operating points (Table IV): V and mg/s.
PARAMETERS: Mapping[str, Mapping[str, float]] = {
    f"{V_D}V_{mdot_mgs}mgs": {"V_D": float(V_D), "mdot_mgs": float(mdot_mgs)}
    for V_D, mdot_mgs in ((200, 5), (300, 2), (300, 4), (300, 5), (300, 6), (400, 5))
}
LAW = polynomial(["V_D", "mdot_mgs"], degree=1)
# State -> term -> coefficients of 1, V_D and mdot_mgs in the law.
TRUTH: Mapping[str, Mapping[str, Sequence[float]]] = {
    "n_i": {"n_i": (-0.4, -0.002, 0.0), "n_i*n_n": (1.0, 0.002, -0.05)},
    "n_n": {"1": (0.0, 0.0, 0.015), "n_i*n_n": (-1.0, -0.002, 0.05)},
}
LIBRARY = polynomial(list(TRUTH), degree=3)
DURATION_S, RATE_HZ = 15.0, 10.0  # small oscillations last 18 to 30 s
# Where records start, drawn evenly between: away from the steady state, which would show little.
INITIAL = ((0.1, 0.4), (0.5, 1.6))


def system_at(parameters: Mapping[str, float]) -> System:
    """The member of the family at one operating point."""
    law = LAW.evaluate(np.array([parameters[name] for name in LAW.variables]))
    equations = {
        state: {term: float(law @ coef) for term, coef in terms.items()}
        for state, terms in TRUTH.items()
    }
    coef = coef_matrix(LIBRARY, list(equations.values()))
    model = SparseModel(LIBRARY, list(equations), coef, provenance={"truth": "breathing family"})
    return System("breathing family", model, np.mean(INITIAL, axis=0), DURATION_S, RATE_HZ)


def realization(noise: float, number: int, *, seed: int = 0) -> dict[str, list[Trajectory]]:
    """One noisy record per point, from a random start; noise levels share starts and pattern.

    noise: standard deviation of the white noise, in RMS of each state.
    """
    rng = np.random.default_rng([seed, number])
    starts = rng.uniform(*INITIAL, size=(len(PARAMETERS), len(TRUTH)))
    return {
        point: [system_at(parameters).trajectory(initial=start, noise=noise, rng=stream)]
        for (point, parameters), start, stream in zip(
            PARAMETERS.items(), starts, rng.spawn(len(PARAMETERS)), strict=True
        )
    }


@dataclass(frozen=True)
class Method:
    """What joint search and single points have in common."""

    formulation: Formulation
    search: Search
    selection: Selection
    depth: int = 1

    def find(self, points: Mapping[str, Sequence[Trajectory]]) -> JointDiscovery:
        return discover_jointly(
            points,
            LIBRARY,
            formulation=self.formulation,
            search=self.search,
            selection=self.selection,
            depth=self.depth,
            rng=np.random.default_rng(0),
        )


def run_family(
    method: Method,
    *,
    noises: Sequence[float],
    n_realizations: int,
    workers: Workers,
    seed: int = 0,
    progress: Callable[[int], None] = lambda n_done: None,
) -> pd.DataFrame:
    """Search every realization at all points jointly, and at every point alone.

    One row per noise and number. joint, pooled and one column per point: 1 where the supports of
    all equations are right; pooled is one regression over all points, with one set of
    coefficients. error_free, error_tied: RMS relative error of the coefficients at all points,
    free or tied by the true law, and p_value the least of the equations', where joint is right.
    """
    if n_realizations < 1 or not len(noises):
        raise ValueError(
            "a study needs a noise level and a realization at least: "
            f"noises={list(noises)}, n_realizations={n_realizations}"
        )
    tasks = [(noise, number) for noise in noises for number in range(n_realizations)]
    rows = {}
    for k, row in workers.run(partial(outcome, method, seed=seed), tasks):
        rows[k] = row
        progress(len(rows))
    return pd.DataFrame([rows[k] for k in range(len(tasks))])


def outcome(method: Method, task: tuple[float, int], *, seed: int = 0) -> dict[str, float]:
    """One realization: one row of `run_family`."""
    noise, number = task
    points = realization(noise, number, seed=seed)
    joint = method.find(points)
    pooled = method.find({"all": [run for runs in points.values() for run in runs]})
    row = {"noise": noise, "number": number, "joint": _right(joint), "pooled": _right(pooled)}
    row |= {point: _right(method.find({point: runs})) for point, runs in points.items()}
    return row | (_errors(joint) if row["joint"] else dict.fromkeys(ERRORS, np.nan))


def _right(found: JointDiscovery) -> float:
    return float(all(set(found.chosen[state]) == set(terms) for state, terms in TRUTH.items()))


ERRORS = ("error_free", "error_tied", "p_value")


def _errors(joint: JointDiscovery) -> dict[str, float]:
    tied = tied_fit(joint, LAW, parameters=PARAMETERS)
    errors: dict[str, list[float]] = {"error_free": [], "error_tied": []}
    for point, parameters in PARAMETERS.items():
        truth = system_at(parameters).model
        for name, model in (
            ("error_free", joint.models[point]),
            ("error_tied", tied.model_at(parameters)),
        ):
            used = truth.coef != 0.0
            errors[name] += (model.coef[used] / truth.coef[used] - 1.0).tolist()
    found = {name: float(np.sqrt(np.mean(np.square(each)))) for name, each in errors.items()}
    return found | {"p_value": min(e.p_value for e in tied.equations.values())}


def rates(outcomes: pd.DataFrame) -> pd.DataFrame:
    """Realizations with the right support, in %, by noise: joint, pooled, every point alone."""
    shown = ["joint", "pooled", *PARAMETERS]
    return 100.0 * outcomes.groupby("noise")[shown].mean()
