"""Growth and frequency of the breathing mode from averages: `python -m benchmarks.linear_criteria`.

Two densities, of which each process is a power near the means. Ions are renewed at the rate nu_i,
what ionization moves over n_i, neutrals at nu_n, the same over n_n, and leave at s. Ionization, net
of what comes back, is of order p in n_i and q in n_n; what leaves as ions is of order r in n_i. The
Jacobian of the logarithms has

    trace        nu_i (p - r) - nu_n q - s              twice the growth rate
    determinant  nu_i nu_n q r - nu_i s (p - r)         that of a slow mode: the frequency squared

Prints, for every operating point, growth and frequency of the law's rest point, and what theories
in zero dimensions say of the averages of the same record. The tables of docs/theories.md.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

import ep2sindy as ep
from benchmarks import living
from ep2sindy.studies.processes import fitted_rate, recorded_rates

N_I, N_N, HEATED, BY_NEUTRALS = "n_i", "n_n", "n_i^2*n_n", "n_i*n_n^2"
PRODUCT, IONS_SQUARED = "n_i*n_n", "n_i^2"


@dataclass(frozen=True)
class Orders:
    """Rates per particle in 1/s, and the orders of ionization and of the ions' outflow."""

    nu_i: float
    nu_n: float
    s: float
    p: float = 1.0
    q: float = 1.0
    r: float = 1.0

    @property
    def eigenvalue(self) -> complex:
        """Of the mode that grows fastest, in 1/s: growth, and i times the angular frequency."""
        trace = self.nu_i * (self.p - self.r) - self.nu_n * self.q - self.s
        determinant = self.nu_i * self.nu_n * self.q * self.r - self.nu_i * self.s * (
            self.p - self.r
        )
        return 0.5 * trace + np.emath.sqrt(0.25 * trace**2 - determinant)

    @property
    def parts(self) -> str:
        """What drives the mode, and what damps it."""
        return (
            f"p {self.p:.2f}, q {self.q:.2f}, r {self.r:.2f}; {self.nu_i * (self.p - self.r):.3g} "
            f"against {self.nu_n * self.q:.3g} + {self.s:.3g} 1/s"
        )


def order(terms: dict[str, float], at: np.ndarray, state: int) -> float:
    """d ln(rate) / d ln(state) of a rate, which is a sum of terms, at a point."""
    library = ep.polynomial(living.STATES, degree=3)
    coef = np.array(list(terms.values()))
    columns = [library.index(term) for term in terms]

    def rate(values: np.ndarray) -> float:
        return float(library.evaluate(values[None])[0, columns] @ coef)

    step = 1e-5 * np.eye(2)[state]
    return float(np.log(rate(at * np.exp(step)) / rate(at * np.exp(-step))) / 2e-5)


def law_at_rest(whole: living.Record) -> tuple[ep.model.RestPoint, Orders]:
    """The law of five terms refined on three quarters: rest point, rates and orders there."""
    fitted, judged = living.parts(whole.run, "last")
    model = living.law(fitted, whole, seed=0).model
    run = ep.evaluate(model, judged, initial=living.start_of(judged, model))
    assert run.rest is not None
    at, ions, neutrals = run.rest.state, model.terms(N_I), model.terms(N_N)
    moved = {term: ions[term] for term in (HEATED, BY_NEUTRALS)}
    leaves = {term: -ions[term] for term in (N_I, IONS_SQUARED)}
    nu_i = leaves[N_I] + leaves[IONS_SQUARED] * at[0]
    return run.rest, Orders(
        nu_i,
        nu_i * at[0] / at[1],
        -neutrals[N_N],
        *(order(moved, at, state) for state in (0, 1)),
        order(leaves, at, 0),
    )


def theories(whole: living.Record, speed_m_s: float) -> dict[str, Orders]:
    """Structures in two densities, each with its rates by the means, and orders by least squares.

    Predator and prey have neutrals that grow by themselves, at the rate at which they cross.
    """
    run, rates = whole.run, recorded_rates(whole.balances[""], whole.run)
    means = run.states.mean(axis=0)
    net = rates["ionization"] - rates["returned"]
    nu_i, s = rates["exit_i"].mean() / means[0], rates["exit_n"].mean() / means[1]
    nu_n = net.mean() / means[1]

    def orders(rate: np.ndarray, terms: Sequence[str]) -> list[float]:
        library = ep.polynomial(living.STATES, degree=3)
        columns = library.evaluate(run.states)[:, [library.index(term) for term in terms]]
        fit = fitted_rate(rate, columns, terms).terms
        return [order(dict(fit), means, state) for state in (0, 1)]

    crossing = speed_m_s / ep.thruster.Thruster().channel_length
    out = orders(rates["exit_i"], [N_I, IONS_SQUARED])[0]
    return {
        "predator and prey": Orders(nu_i, crossing, -crossing),
        "supply, k": Orders(nu_i, nu_n, s),
        "supply, k, return": Orders(nu_i, nu_n, s, q=rates["ionization"].mean() / net.mean()),
        "supply, k by n_n": Orders(nu_i, nu_n, s, *orders(net, [PRODUCT, BY_NEUTRALS])),
        "supply, k by n_i": Orders(nu_i, nu_n, s, *orders(net, [PRODUCT, HEATED])),
        "terms of the law": Orders(nu_i, nu_n, s, *orders(net, [HEATED, BY_NEUTRALS]), out),
    }


def row(name: str, found: complex, parts: str = "") -> str:
    growth, frequency = found.real, abs(found.imag) / (2e3 * np.pi)
    return f"    {name:20s} growth {growth:8.0f} 1/s, {frequency:5.1f} kHz   {parts}"


def main() -> None:
    """Print the points of the default source, or those of the sets that are named."""
    for name in sys.argv[1:] or ["default"]:
        for label in living.oscillating(name):
            whole = living.record(label, living.CHANNEL, name)
            field = living.field(label, name)
            print(f"\n{name}, {label}: cycle {field.attrs['f_kHz']:.1f} kHz")
            if name == "default":
                rest, orders = law_at_rest(whole)
                turning = rest.growth_per_s + 2j * np.pi * rest.frequency_Hz
                print(row("law, Jacobian", turning))
                print(row("law, closed form", orders.eigenvalue, orders.parts))
            speed = living.LIF_SPEED if name == "lif" else living.POINTS[label].neutral_speed
            for theory, orders in theories(whole, float(speed)).items():
                print(row(theory, orders.eigenvalue, orders.parts), flush=True)


if __name__ == "__main__":
    main()
