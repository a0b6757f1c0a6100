"""Growth and frequency of the breathing mode from averages: `python -m benchmarks.linear_criteria`.

Two densities, of which each process is a power near the means. Ions are renewed at the rate nu_i,
what ionization moves over n_i, neutrals at nu_n, the same over n_n, and leave at s. Ionization, net
of what comes back, is of order p in n_i and q in n_n; the ions' outflow is of order r in n_i and u
in n_n. The Jacobian of the logarithms has

    trace        nu_i (p - r) - nu_n q - s                  twice the growth rate
    determinant  nu_i nu_n (q r - p u) - nu_i s (p - r)     squares of frequency and growth, added

Prints, for every operating point, growth and frequency of the law's rest point, and what theories
in zero dimensions say of the averages of the same record, next to the law's: small oscillations are
compared with small ones, the cycle is large. `python -m benchmarks.sustained growth` prints how far
equal models of one record differ. Both make the table of docs/theories.md.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

import ep2sindy as ep
from benchmarks import sustained
from ep2sindy.studies.processes import fitted_rate, recorded_rates

IONS, NEUTRALS = sustained.STATES
LIBRARY = ep.polynomial(sustained.STATES, degree=3)
STEP = 1e-5  # of a logarithm, for the orders
# Terms of ionization, net of what comes back, and of the ions that leave: of the law, of the law of
# `thruster=lif`, and of structures of conf/exp/theories.yaml. Predator and prey have neutrals that
# grow by themselves, as fast as they cross.
LAW = (["n_i^2*n_n", "n_i*n_n^2"], ["n_i", "n_i^2"])
STRUCTURES = {
    "terms of lif": (
        ["n_i*n_n", "n_i^2*n_n", "n_i*n_n^2", "n_i"],
        ["n_i", "n_i^2", "n_i*n_n^2"],
    ),
    "supply": (["n_i*n_n"], ["n_i"]),
    "back_flow": (["n_i*n_n", "n_i"], ["n_i"]),
}


@dataclass(frozen=True)
class Balance:
    """Rates per particle in 1/s, and the orders of ionization and of the ions' outflow.

    ionized, leave: orders in n_i and in n_n.
    """

    nu_i: float
    nu_n: float
    s: float
    ionized: tuple[float, float] = (1.0, 1.0)
    leave: tuple[float, float] = (1.0, 0.0)

    @property
    def eigenvalue(self) -> complex:
        """Of the mode that grows fastest, in 1/s: growth, and i times the angular frequency."""
        (p, q), (r, u) = self.ionized, self.leave
        driven = self.nu_i * (p - r)
        half_trace = 0.5 * (driven - self.nu_n * q - self.s)
        determinant = self.nu_i * self.nu_n * (q * r - p * u) - driven * self.s
        return half_trace + complex(np.emath.sqrt(half_trace**2 - determinant))


def orders(terms: Mapping[str, float], at: np.ndarray) -> tuple[float, float]:
    """d ln(rate) / d ln(n_i) and d ln(rate) / d ln(n_n) of a sum of terms."""
    coef, columns = np.array(list(terms.values())), [LIBRARY.index(term) for term in terms]
    near = at * np.exp(STEP * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]]))
    logs = np.log(LIBRARY.evaluate(near)[:, columns] @ coef)
    return (logs[0] - logs[1]) / (2.0 * STEP), (logs[2] - logs[3]) / (2.0 * STEP)


def law_at_rest(whole: sustained.Record) -> tuple[complex, Balance]:
    """The law refined on three quarters: eigenvalue of its rest point, and its balance there."""
    fitted, assessed = sustained.parts(whole.run, "last")
    model = sustained.law(fitted, whole, seed=0).model
    run = ep.evaluate(model, assessed, initial=sustained.start_of(assessed, model))
    rest = sustained.rest_of(run)
    assert rest is not None
    moved, leave = [
        {term: sign * model.terms(IONS)[term] for term in terms}
        for sign, terms in zip((1.0, -1.0), LAW, strict=True)
    ]
    columns = [LIBRARY.index(term) for term in moved]
    ionized = float(LIBRARY.evaluate(rest.state[None])[0, columns] @ list(moved.values()))
    nu_i, nu_n = ionized / rest.state
    found = Balance(
        nu_i, nu_n, -model.terms(NEUTRALS)["n_n"],
        orders(moved, rest.state), orders(leave, rest.state),
    )  # fmt: skip
    return complex(rest.growth_per_s, 2.0 * np.pi * rest.frequency_Hz), found


def theories(whole: sustained.Record, crossing: float) -> dict[str, Balance]:
    """Structures with their rates by the means of the record, and orders by least squares on it.

    crossing: speed of the neutrals over the channel's length, in 1/s.
    """
    run, rates = whole.run, recorded_rates(whole.balances[""], whole.run)
    means, theta = run.states.mean(axis=0), LIBRARY.evaluate(run.states)
    net = rates["ionization"] - rates["returned"]

    def fitted(rate: np.ndarray, terms: Sequence[str]) -> dict[str, float]:
        columns = theta[:, [LIBRARY.index(term) for term in terms]]
        return dict(fitted_rate(rate, columns, terms).terms)

    nu_i, s = rates["exit_i"].mean() / means[0], rates["exit_n"].mean() / means[1]
    returned = -rates["returned"].mean() / means[0]
    found = {"predator_prey": Balance(nu_i, crossing, -crossing)}
    for name, (ionized, leave) in STRUCTURES.items():
        # Ions that come back by w n_i are a process of their own, which the record gives.
        gross = "n_i" in ionized
        terms = fitted(rates["ionization"] if gross else net, [t for t in ionized if t != "n_i"])
        found[name] = Balance(
            nu_i,
            net.mean() / means[1],
            s,
            orders(terms | ({"n_i": returned} if gross else {}), means),
            orders(fitted(rates["exit_i"], leave), means),
        )
    return found


def row(name: str, found: complex, law: complex) -> str:
    growth, frequency = found.real, abs(found.imag) / (2e3 * np.pi)
    return (
        f"    {name:18s} growth {growth:7.0f} 1/s, {frequency:5.1f} kHz; of the law's: growth "
        f"{growth / law.real:6.2f}, frequency {abs(found.imag / law.imag):.3f}"
    )


def main() -> None:
    """Print all points of the default source."""
    for label in sustained.POINTS:
        whole = sustained.record(label)
        turning, balance = law_at_rest(whole)
        cycle = ep.signals.find_cycle(whole.run.t, whole.run.states)
        assert cycle is not None
        ratio = abs(turning.imag) / (2.0 * np.pi * cycle.frequency_Hz)
        cycle_kHz = 1e-3 * cycle.frequency_Hz
        print(f"\n{label}: cycle {cycle_kHz:.2f} kHz; law at rest {ratio:.3f} of it")
        print(row("law, Jacobian", turning, turning))
        print(row("law, closed form", balance.eigenvalue, turning))
        speed = float(sustained.POINTS[label].neutral_speed_at(np.zeros(1))[0])
        crossing = speed / ep.thruster.Thruster().channel_length
        for theory, balance in theories(whole, crossing).items():
            print(row(theory, balance.eigenvalue, turning), flush=True)


if __name__ == "__main__":
    main()
