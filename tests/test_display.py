"""Objects that a person can read: one screen at most, the equations in it, HTML escaped."""

from dataclasses import replace

import numpy as np
import pytest

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.discover import discover
from ep2sindy.discovery.method import Regression
from ep2sindy.discovery.result import Discovery
from ep2sindy.library.library import Library, named_terms, polynomial
from ep2sindy.model.model import SparseModel, coef_matrix
from ep2sindy.refinement.assess import RefinementStatus
from ep2sindy.refinement.refine import Refinement, refine
from ep2sindy.regression.ambiguity import Ambiguity
from ep2sindy.regression.bootstraps import Bootstraps
from ep2sindy.regression.formulations import Differential
from ep2sindy.regression.searches import BestSubset
from ep2sindy.selection.criteria import EBIC
from ep2sindy.systems.systems import lotka_volterra

UNITS = {"n_i": "m^-3", "n_n": "m^-3"}


def breathing() -> SparseModel:
    library = named_terms(["n_i", "n_n"], ["1", "n_i", "n_i*n_n"])
    equations = [{"n_i": -2.62e5, "n_i*n_n": 5.481e-14}, {"1": 1.83e23}]
    return SparseModel(library, ["n_i", "n_n"], coef_matrix(library, equations), UNITS)


def crowded(n_states: int = 3, *, known: bool = False) -> SparseModel:
    """Every term of degree 4 or less in every equation."""
    names = [f"state_{k}" for k in range(n_states)]
    library = polynomial(names[:4], degree=4)
    coef = np.random.default_rng(0).normal(size=(len(library), n_states))
    model = SparseModel(library, names, coef)
    return replace(model, covariance=np.eye(coef.size)) if known else model


@pytest.fixture(scope="module")
def discovery() -> Discovery:
    system = lotka_volterra()
    recipe = Regression(Differential(), BestSubset(), EBIC(), Bootstraps(n=2))
    return discover(system.trajectory(), system.model.library, recipe)


@pytest.fixture(scope="module")
def refinement() -> Refinement:
    system = lotka_volterra()
    rng = np.random.default_rng(0)
    return refine(system.model, [system.trajectory()], n_windows=4, window=60, seed=rng)


def assert_one_screen(text: str) -> None:
    lines = text.splitlines()
    assert 0 < len(lines) <= 25
    assert max(map(len, lines)) <= 100


def test_a_model_prints_its_equations_with_units() -> None:
    assert str(breathing()) == (
        "n_i' = -2.62e+05 n_i + 5.48e-14 n_i n_n [m^-3 s^-1]\n"
        "n_n' = 1.83e+23 [m^-3 s^-1]\n"
        "n_i in m^-3, n_n in m^-3, t in s"
    )
    assert repr(breathing()).startswith("SparseModel of 2 equations, 3 terms\nn_i' = ")


def test_a_model_prints_intervals_where_it_knows_them() -> None:
    model = replace(breathing(), covariance=np.diag([1e6, 1e-32, 1e42]))
    assert "n_i' = -2.62e+05 (±2e+03) n_i + 5.48e-14 (±2e-16) n_i n_n" in str(model)
    assert str(model).endswith("t in s; ± 95 % intervals")
    assert "(&plusmn;2&times;10<sup>3</sup>) <i>n</i>" in model._repr_html_()


def test_a_model_without_terms_prints_zeros() -> None:
    model = SparseModel(polynomial(["x"], degree=1), ["x"], np.zeros((2, 1)))
    assert str(model) == "x' = 0 [s^-1]\nt in s"
    assert "d<i>x</i>/dt = 0" in model._repr_html_()
    assert model._repr_latex_().startswith("$$\\begin{aligned}\n\\dot{x} &= 0")


@pytest.mark.parametrize("n_states", [1, 3, 24, 40])
@pytest.mark.parametrize("known", [False, True])
def test_long_models_end_in_how_much_is_left(n_states: int, known: bool) -> None:
    model = crowded(n_states, known=known and n_states < 24)
    for text in (str(model), repr(model)):
        assert_one_screen(text)
    assert ("more terms" in str(model)) == (n_states == 3)  # 5 terms fit; 70 of 24 have one line
    assert ("more equations" in str(model)) == (n_states == 40)
    assert "state_0' = " in str(model)
    assert model._repr_html_().count("<div>") == n_states + 1


def test_html_is_escaped() -> None:
    names = ["a", "b", "<i*j>"]
    model = SparseModel(Library(names, np.eye(3, dtype=np.int64)), names, np.eye(3), {"a": "<u>&"})
    found = model._repr_html_()
    assert "&lt;u&gt;&amp;" in found
    assert "&lang;<i>i</i> <i>j</i>&rang;" in found
    assert "<b>" not in found
    assert "<u>" not in found
    t = np.arange(3.0)
    run = Trajectory(t=t, states=t[:, None], state_names=["<i*j>"], label="<script>")
    assert "<i" not in (run._repr_html_() + model.library._repr_html_()).replace("<i>", "")
    assert "<script>" not in run._repr_html_()


def test_a_trajectory_tells_its_samples_steps_units_and_ranges() -> None:
    t = 1e-6 * np.arange(5.0)
    run = Trajectory(
        t=t, states=t[:, None] * 1e24, state_names=["n_i"], inputs=np.full((5, 1), 300.0),
        input_names=["V_d"], units={"n_i": "m^-3", "V_d": "V"}, label="run 7",
    )  # fmt: skip
    assert repr(run) == (
        "Trajectory 'run 7': 5 samples, t = 0 to 4e-06 s in steps of 1e-06 s\n"
        "            unit  from  to\n"
        "state  n_i  m^-3  0     4e+18\n"
        "input  V_d  V     300   300"
    )
    assert "<td>V_d</td><td>V</td><td>300</td>" in run._repr_html_()
    uneven = replace(run, t=np.array([0.0, 1.0, 3.0, 4.0, 5.0]))
    assert "in steps of 1 to 2 s" in repr(uneven)


def test_a_library_counts_its_terms_by_degree() -> None:
    assert repr(polynomial(["x", "y"], degree=2)) == (
        "Library of 6 terms over x, y\n1 of degree 0: 1\n2 of degree 1: x y\n"
        "3 of degree 2: x^2 x*y y^2"
    )
    large = repr(polynomial([f"variable_{k}" for k in range(12)], degree=4))
    assert_one_screen(large)
    assert "1365 of degree 4:" in large


def test_a_discovery_shows_equations_rule_and_notes(discovery: Discovery) -> None:
    text = repr(discovery)
    assert text.startswith("Discovery of 2 equations, chosen by EBIC(gamma=1.0")
    assert str(discovery.model) in text
    notes = [Ambiguity(("x",), f"'x' < {k}: " + "word " * 40, False) for k in range(30)]
    doubtful = replace(discovery, ambiguities=notes, model=crowded(3))
    assert_one_screen(repr(doubtful))
    assert repr(doubtful).endswith("... 24 more notes")
    assert "&lt; 0: word" in doubtful._repr_html_()


def test_a_refinement_shows_status_loss_and_intervals(refinement: Refinement) -> None:
    assert repr(refinement).startswith("Refinement: converged, loss ")
    assert "(±" in repr(refinement)
    status = RefinementStatus.NON_FINITE
    failed = replace(refinement, status=status, loss=float("inf"), model=breathing())
    assert "non_finite, loss inf" in repr(failed)
    assert "±" not in repr(failed)
