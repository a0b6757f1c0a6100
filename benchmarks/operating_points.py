"""The six operating points against a reference code: discharge current and zone coefficients.

    python -m benchmarks.operating_points

Prints the tables of docs/thruster.md; tests/test_thruster_reference.py holds them. The
reference values are another code's run of the same parameter set.
"""

import numpy as np
import xarray as xr

from ep2sindy.data.zones import Zone, zone_average
from ep2sindy.library.library import named_terms
from ep2sindy.regression.differential import Differential
from ep2sindy.regression.splits import RandomSplit
from ep2sindy.search.front import fit_support
from ep2sindy.thruster.parameters import OPERATING_POINTS, Thruster
from ep2sindy.thruster.simulate import simulate

# I_d mean (A), standard deviation (A) and frequency (kHz).
CURRENTS = {
    "200V_5mgs": (3.37, 3.45, 11.7),
    "300V_2mgs": (1.48, 1.39, 12.7),
    "300V_4mgs": (3.50, 3.03, 15.7),
    "300V_5mgs": (4.48, 4.60, 14.3),
    "300V_6mgs": (5.36, 6.60, 13.7),
    "400V_5mgs": (5.23, 4.75, 17.0),
}
DOWNSTREAM, MIDDLE = (1.5e-2, 2.5e-2), (1.0e-2, 2.5e-2)  # m
EQUATIONS = (
    ("n_i", ("n_i", "n_i*n_n")),
    ("n_n", ("n_n", "n_i*n_n")),
    ("n_i", ("n_i*u_iz", "n_i*n_n*R_ion")),
    ("n_n", ("1", "n_i*n_n*R_ion")),
    ("n_n", ("1", "n_n", "n_i*n_n*R_ion")),
)
# Least-squares coefficients on zone averages, in SI, equation by equation.
COEFFICIENTS = {
    ("300V_5mgs", DOWNSTREAM): (
        (-2.91e5, 4.31e-14), (4.92e4, -5.18e-14), (-39.4, 0.59), (1.75e23, -0.63),
        (-9.7e22, 7.15e4, -0.95),
    ),
    ("300V_5mgs", MIDDLE): (
        (-2.48e5, 2.98e-14), (4.20e4, -5.86e-14), (-43.9, 0.48), (2.86e23, -0.85),
        (8.0e22, 3.07e4, -0.94),
    ),
    ("200V_5mgs", DOWNSTREAM): (
        (-2.26e5, 2.21e-14), (4.10e4, -7.13e-14), (-43.9, 0.69), (2.60e23, -1.28),
    ),
    ("300V_2mgs", DOWNSTREAM): (
        (-5.44e5, 1.22e-13), (1.39e4, -8.21e-14), (-50.1, 0.99), (5.6e22, -0.77),
    ),
    ("300V_4mgs", DOWNSTREAM): (
        (-3.76e5, 7.87e-14), (3.62e4, -7.12e-14), (-42.1, 0.81), (1.21e23, -0.69),
    ),
    ("300V_6mgs", DOWNSTREAM): (
        (-3.09e5, 3.48e-14), (6.17e4, -4.64e-14), (-49.3, 0.66), (2.50e23, -0.66),
    ),
    ("400V_5mgs", DOWNSTREAM): (
        (-2.97e5, 8.46e-14), (5.65e4, -7.62e-14), (-32.2, 0.72), (1.39e23, -0.61),
    ),
}  # fmt: skip


def coefficient_ratios(field: xr.Dataset, case: tuple[str, tuple[float, float]]) -> np.ndarray:
    """Our coefficients over the reference's, for every equation of one point and zone."""
    run = zone_average(
        field, Zone(z=case[1]), states=["n_i", "n_n"], inputs=["R_ion", "u_iz"], label=case[0]
    )
    names = dict.fromkeys(name for _, terms in EQUATIONS for name in terms)
    every_row = Differential(split=RandomSplit(test_fraction=0.0))
    (problem,) = every_row.assemble(
        [run], named_terms(run.names, list(names)), rng=np.random.default_rng(0)
    )
    ratios = []
    for (state, terms), reference in zip(EQUATIONS, COEFFICIENTS[case], strict=False):
        ours = fit_support(problem, state, terms).coef_by_term
        ratios += [ours[name] / value for name, value in zip(terms, reference, strict=True)]
    return np.array(ratios)


def main() -> None:
    everything = []
    for point in OPERATING_POINTS:
        field = simulate(Thruster(), point, progress=False)
        attributes = field.attrs
        mean, std, f_kHz = CURRENTS[point.label]
        print(
            f"{point.label}: {attributes['status']}, I_d {attributes['I_d_mean']:.2f} / "
            f"{attributes['I_d_std']:.2f} A, {attributes['f_kHz']:.1f} kHz, mass "
            f"{attributes['mass_balance']:.4f}; reference {mean} / {std} A, {f_kHz} kHz"
        )
        for case in COEFFICIENTS:
            if case[0] == point.label:
                ratios = coefficient_ratios(field, case)
                everything.append(ratios)
                print(f"  from {case[1][0] * 100:g} cm, ours / reference:", np.round(ratios, 2))
    close = np.abs(np.concatenate(everything) - 1.0) < 0.15
    print(f"within 15 %: {close.sum()} of {close.size} coefficients")


if __name__ == "__main__":
    main()
