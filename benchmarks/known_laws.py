"""Twelve records of a system whose law is known: is the law found, and what does it predict?

    python -m benchmarks.known_laws
    python -m benchmarks.known_laws 5      # seeds per noise level

A Brusselator over one parameter, and a breathing discharge in SI units over voltage and mass flow.
Their coefficients are linear, quadratic and reciprocal in these, and no fit is told which. Per
system and noise: the seeds whose terms are all right; the root mean square error of all
coefficients at all points, from each point's record alone, by its rows and refined, and by the law;
the same of points left out, by the law of the others; the greatest error of the frequency there,
running freely; the functions of the law; CPU time.
"""

import sys
import time
from contextlib import suppress
from dataclasses import replace
from functools import cache
from itertools import chain, product

import numpy as np

import ep2sindy as ep
from ep2sindy.operating.fit import SETTINGS, OperatingFit, operating_fit
from ep2sindy.operating.law import OperatingLaw, read_coefficients
from ep2sindy.operating.records import OperatingRecord
from ep2sindy.refinement.methods.multiple_shooting import MultipleShooting
from ep2sindy.refinement.steps import RungeKutta

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
FINER = replace(SETTINGS, method=MultipleShooting(step=RungeKutta(4)))  # a pulse in few samples
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
        model, t = law.model_at(point), np.arange(4000) * period_s / PER_PERIOD
        warm = model.simulate(t, start).states[2000:]
        cycle = OperatingRecord.of(point, ep.Trajectory(t[:2000], warm, law.states)).cycle
        t = np.arange(N_PERIODS * PER_PERIOD) / (PER_PERIOD * cycle.frequency_Hz)
        found.append(ep.Trajectory(t, model.simulate(t, warm[0]).states, law.states))
    return found


def records(system: str, *, noise: float, seed: int) -> list[OperatingRecord]:
    """Records of all points with white noise. noise: in standard deviations of each state."""
    rng, found = np.random.default_rng(seed), []
    for point, run in zip(POINTS[system], cycles(system), strict=True):
        added = noise * run.states.std(axis=0) * rng.standard_normal(run.states.shape)
        noisy = ep.Trajectory(run.t, run.states + added, run.state_names)
        found.append(OperatingRecord.of(point, noisy))
    return found


def leave_out(fit: OperatingFit, functions: ep.Library) -> list[ep.SparseModel]:
    """The model at every point by the law of the other points."""
    return [
        fit.without(k).fit_law(functions).model_at(record.parameters, extrapolate=True)
        for k, record in enumerate(fit.records)
    ]


def choose_functions(fit: OperatingFit) -> ep.Library:
    """The functions whose law predicts points left out best: p and, or not, p^2 and 1/p of each p.

    The misses are weighted by the information of each point's own coefficients.
    """
    own = [[[], [f"{p}^2"], [f"1/{p}"], [f"{p}^2", f"1/{p}"]] for p in fit.records[0].parameters]
    names, scores = list(fit.records[0].parameters), {}
    for more in product(*own):
        functions = ep.named_terms(names, ["1", *names, *chain(*more)])
        with suppress(ValueError):  # the points do not suffice for these
            models = leave_out(fit, functions)
            predicted = [read_coefficients(model, fit.relations.common) for model in models]
            off = np.array(predicted) - fit.coefficients
            scores[functions] = float(np.einsum("pi,pij,pj->", off, fit.information, off))
    return min(scores, key=scores.__getitem__)


def outcome(system: str, noise: float, seed: int) -> tuple[list[float], str]:
    """Errors in %, none if the terms are wrong, and the functions of the law."""
    law, found, start = truth(system), records(system, noise=noise, seed=seed), time.process_time()
    shared = ep.discover_shared({r.label: [r.run] for r in found}, law.library)
    if any(set(shared.chosen[s]) != set(LAWS[system][s]) for s in law.states):
        return [], ""
    fit = operating_fit(found, law.library, shared.chosen, settings=FINER)
    functions = choose_functions(fit)
    refined, _ = fit.refine_law(functions)
    others = leave_out(fit, functions)
    runs = [ep.free_run(m, r.from_slowest) for m, r in zip(others, found, strict=True)]
    spent_s, at = time.process_time() - start, POINTS[system]
    models = [
        [shared.models[record.label] for record in found],
        [own.model for own in fit.fits],
        [refined.model_at(point) for point in at],
        others,
    ]
    true = np.array([law.model_at(point).coef for point in at])
    off = np.array([[m.coef for m in each] for each in models])[:, true != 0.0] / true[true != 0.0]
    errors = 100.0 * np.sqrt(np.square(off - 1.0).mean(axis=1))
    worst = 100.0 * max(abs(run.f_error) for run in runs)
    return [*errors.tolist(), worst, spent_s], ", ".join(functions.names)


def main() -> None:
    n_seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 3
    print("system, noise, right | rows, refined, law, left out, frequency (%) | CPU-s | functions")
    for system, noise in product(LAWS, NOISES):
        found = [outcome(system, noise, seed) for seed in range(n_seeds)]
        right = [(errors, functions) for errors, functions in found if errors]
        line = f"{system:<12}{noise:>5.0%}{len(right):>3} of {n_seeds}"
        if right:
            median = np.median([errors for errors, _ in right], axis=0)
            chosen = " or ".join(sorted({functions for _, functions in right}))
            line += "".join(f"{v:8.2f}" for v in median[:5]) + f"{median[5]:8.1f}  {chosen}"
        print(line, flush=True)


if __name__ == "__main__":
    main()
