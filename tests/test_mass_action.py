"""What the terms of a model prove: no negative state, nothing unbounded."""

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.model.mass_action import BOUNDED, NONNEGATIVE, consequences
from tests.models import model_of

D = {
    "n_i": {"n_i^2*n_n": 1.62e-32, "n_i*n_n^2": 3.12e-33, "n_i": -3.64e5, "n_i^2": -8.45e-14},
    "n_n": {"1": 2.31e23, "n_i^2*n_n": -1.62e-32, "n_i*n_n^2": -3.12e-33, "n_n": -2.76e3},
}
FORMER = {
    "n_i": {"n_i": -4.29e5, "n_i^2": 1.08e-13, "n_i^3": -2.14e-32, "n_i*n_n^2": 3.67e-33},
    "n_n": {"1": 2.31e23, "n_i^2": -1.08e-13, "n_n^2": -2e-16, "n_i*n_n^2": -3.67e-33},
}
SIR = {  # births, no deaths: the recovered grow without end
    "S": {"1": 0.1, "S*I": -2.0}, "I": {"S*I": 2.0, "I": -0.5}, "R": {"I": 0.5}
}  # fmt: skip
# Half as large a place takes up what the other one gives: a concentration rises by twice as much.
UNEQUAL = {"a": {"1": 1.0, "a": -1.0}, "b": {"a": 2.0, "b": -3.0}}
GROWING = {"prey": {"prey": 1.0, "prey*fox": -1.0}, "fox": {"prey*fox": 1.0, "fox": -1.0}}
SATURATED = {"a": {"1": 1.0, "a": -1.0, "a*b": -1.0}, "b": {"a*b": 1.0, "b": -1.0, "b^2": 0.5}}


@pytest.mark.parametrize(
    ("terms", "expected"),
    [
        (D, [NONNEGATIVE, BOUNDED]),
        (FORMER, []),  # takes n_i^2 of the neutrals where there are none
        (SIR, [NONNEGATIVE]),
        (UNEQUAL, [NONNEGATIVE, BOUNDED]),
        (GROWING, [NONNEGATIVE]),
        (SATURATED, [NONNEGATIVE]),  # b may run away by its own square
    ],
)
def test_what_terms_prove(terms: dict[str, dict[str, float]], expected: list[str]) -> None:
    assert consequences(model_of(terms)) == expected


def test_runs_do_what_was_proved() -> None:
    model, rng = model_of(D), np.random.default_rng(0)
    t = np.linspace(0.0, 2e-4, 201)
    for start in rng.uniform(0.0, 1.0, (16, 2)) * [2e19, 4e19]:
        path = model.simulate(t, start).states
        assert np.isfinite(path).all()
        assert path.min() >= 0.0


def test_other_functions_and_inputs_prove_nothing() -> None:
    library = ep.polynomial(["x"], degree=1, functions=["sin"])
    turning = ep.SparseModel(library, ["x"], np.array([[0.0], [-1.0], [0.5]]), {"x": "1"})
    assert consequences(turning) == []
    driven = ep.polynomial(["x", "u"], degree=1)
    with_input = ep.SparseModel(
        driven, ["x"], np.array([[0.0], [-1.0], [0.5]]), {"x": "1", "u": "1"}
    )
    assert consequences(with_input) == []
