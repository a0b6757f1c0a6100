"""The closed form of growth and frequency is that of the Jacobian."""

import numpy as np
import pytest
from numpy.random import default_rng
from scipy.optimize import approx_fprime, root

from benchmarks.linear_criteria import Balance, orders


@pytest.mark.parametrize("seed", range(4))
def test_growth_and_frequency_are_those_of_the_jacobian(seed: int) -> None:
    k, a, s = (default_rng(seed).uniform(0.5, 1.5, n) for n in (2, 3, 1))
    ionized = {"n_i^2*n_n": k[0], "n_i*n_n^2": k[1]}
    leave = {"n_i": a[0], "n_i^2": a[1], "n_i*n_n": a[2]}

    def slope(y: np.ndarray) -> np.ndarray:
        made = y[0] * y[1] * (k @ y)
        return np.array(
            [made - y[0] * (a[0] + a[1] * y[0] + a[2] * y[1]), 9.0 - made - s[0] * y[1]]
        )

    rest = root(slope, [1.0, 2.0]).x
    assert (rest > 0.0).all()
    moved = rest[0] * rest[1] * (k @ rest)
    balance = Balance(*(moved / rest), s[0], orders(ionized, rest), orders(leave, rest))
    values = np.linalg.eigvals(approx_fprime(rest, slope, 1e-7))
    leading = values[values.real.argmax()]
    assert balance.eigenvalue.real == pytest.approx(leading.real, rel=1e-5)
    assert abs(balance.eigenvalue.imag) == pytest.approx(abs(leading.imag), rel=1e-5, abs=1e-5)
