"""Twelve records of a system whose law is known: is the law found, and what does it predict?

    python -m benchmarks.known_laws
    python -m benchmarks.known_laws 5      # seeds per noise level

A Brusselator over one parameter, and a breathing discharge in SI units over voltage and mass flow.
Their coefficients are linear, quadratic and reciprocal in these, and `ep.discover` is told
neither terms nor functions. Per system and noise: the seeds whose terms are all right, and the root
mean square error of all coefficients at all points, each point alone and by the law.
"""

import sys
from functools import cache
from itertools import product

import numpy as np

import ep2sindy as ep
from ep2sindy.operating.law import OperatingLaw
from ep2sindy.signals.attractor import find_cycle

NOISES, N_PERIODS, PER_PERIOD = (0.01, 0.05), 30, 50  # noise in each state's standard deviations

# State -> term -> function of the operating point -> its factor.
LAWS = {
    "brusselator": {
        "x": {"1": {"1": 0.6, "u": 0.4}, "x": {"1": -3.0, "u^2": -0.5},
              "x^2*y": {"1": 0.5, "1/u": 0.6}},
        "y": {"x": {"1": 2.0, "u^2": 0.5}, "x^2*y": {"1": -0.5, "1/u": -0.6}},
    },
    "breathing": {  # ions leave; seed electrons; ionization that rises with the ions; inflow
        "n_i": {
            "n_i": {"1/V_D_V": -3.96e7}, "n_n": {"1": 3840.0, "mdot_mg_s": 1212.6},
            "n_i^2*n_n": {"1": 2.811e-32, "V_D_V": -1.104e-34, "V_D_V^2": 1.972e-37},
        },
        "n_n": {
            "1": {"mdot_mg_s": 4.58e22}, "n_n": {"1": -3840.0, "mdot_mg_s": -1212.6},
            "n_i^2*n_n": {"1": -2.811e-32, "V_D_V": 1.104e-34, "V_D_V^2": -1.972e-37},
        },
    },
}  # fmt: skip
VOLTAGES, FLOWS = (290.0, 317.0, 343.0, 370.0), (4.4, 4.75, 5.1)
POINTS = {
    "brusselator": [{"u": u} for u in np.linspace(0.9, 2.0, 12).tolist()],
    "breathing": [{"V_D_V": v, "mdot_mg_s": m} for v, m in product(VOLTAGES, FLOWS)],
}
STARTS = {"brusselator": ((1.0, 1.0), 6.0), "breathing": ((3e18, 3e18), 8e-5)}  # and a period in s


@cache
def truth(system: str) -> OperatingLaw:
    law, points = LAWS[system], POINTS[system]
    rows = {(s, t): factors for s, terms in law.items() for t, factors in terms.items()}
    names = list(dict.fromkeys(name for factors in rows.values() for name in factors))
    coef = [[factors.get(name, 0.0) for name in names] for factors in rows.values()]
    at = np.array([list(point.values()) for point in points])
    functions = ep.named_terms(list(points[0]), names)
    library = ep.polynomial(list(law), degree=3)
    return OperatingLaw(functions, library, tuple(law), tuple(rows), np.array(coef), at)


@cache
def cycles(system: str) -> list[ep.Trajectory]:
    """Records of all points without noise, on the cycle."""
    law, (start, period_s), found = truth(system), STARTS[system], []
    for point in POINTS[system]:
        model, t = law.at(extrapolate=True, **point), np.arange(4000) * period_s / PER_PERIOD
        settled = model.simulate(t, start).states[2000:]
        cycle = find_cycle(t[:2000], settled)
        assert cycle is not None
        t = np.arange(N_PERIODS * PER_PERIOD) / (PER_PERIOD * cycle.frequency_Hz)
        found.append(ep.Trajectory(t, model.simulate(t, settled[0]).states, law.states))
    return found


def records(system: str, *, noise: float, seed: int) -> list[ep.Trajectory]:
    """Records of all points with white noise. noise: in standard deviations of each state."""
    rng, found = np.random.default_rng(seed), []
    for point, run in zip(POINTS[system], cycles(system), strict=True):
        added = noise * run.states.std(axis=0) * rng.standard_normal(run.states.shape)
        states = run.states + added
        found.append(ep.Trajectory(run.t, states, run.state_names, parameters=point))
    return found


def outcome(system: str, noise: float, seed: int) -> list[float]:
    """Errors in % of each point alone and by the law; none if the terms are wrong."""
    law, at = truth(system), POINTS[system]
    found = ep.discover(records(system, noise=noise, seed=seed), law.library, law="auto")
    if any(set(found.model.terms(s)) != set(LAWS[system][s]) for s in law.states):
        return []
    own = found.law
    assert own is not None
    models = [
        [point.model for point in found.points.values()],
        [own.at(extrapolate=True, **point) for point in at],
    ]
    true = np.array([law.at(extrapolate=True, **point).coef for point in at])
    off = np.array([[m.coef for m in each] for each in models])[:, true != 0.0] / true[true != 0.0]
    return (100.0 * np.sqrt(np.square(off - 1.0).mean(axis=1))).tolist()


def main() -> None:
    n_seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 3
    print("system, noise, right | error in %: each point alone, the law")
    for system, noise in product(LAWS, NOISES):
        right = [off for seed in range(n_seeds) if (off := outcome(system, noise, seed))]
        medians = "".join(f"{v:8.2f}" for v in np.median(right, axis=0)) if right else ""
        print(f"{system:<12}{noise:>5.0%}{len(right):>3} of {n_seeds}{medians}", flush=True)


if __name__ == "__main__":
    main()
