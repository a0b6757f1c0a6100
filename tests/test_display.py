"""Objects that a person can read: one screen at most, the equations in it, HTML escaped."""

import re
from dataclasses import replace

import numpy as np

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.equations import equation_text
from ep2sindy.library.library import Library, named_terms, polynomial
from ep2sindy.model.model import SparseModel
from ep2sindy.report.document import Equation
from ep2sindy.report.models import interval_table


def crowded(n_states: int) -> SparseModel:
    """Every term of degree 4 or less in every equation."""
    names = [f"state_{k}" for k in range(n_states)]
    library = polynomial(names[:4], degree=4)
    coef = np.random.default_rng(0).normal(size=(len(library), n_states))
    return SparseModel(library, names, coef)


def test_html_is_escaped() -> None:
    names = ["a", "b", "<i*j>"]
    model = SparseModel(Library(names, np.eye(3, dtype=np.int64)), names, np.eye(3), {"a": "<u>&"})
    found = model._repr_html_()
    assert "&lt;u&gt;&amp;" in found
    assert "⟨ij⟩" in re.sub("<[^>]*>", "", found)
    assert "<b>" not in found
    assert "<u>" not in found
    t = np.arange(3.0)
    run = Trajectory(t=t, states=t[:, None], state_names=["<i*j>"], label="<script>")
    assert "<i" not in (run._repr_html_() + model.library._repr_html_()).replace("<i>", "")
    assert "<script>" not in run._repr_html_()


def test_a_known_coefficient_has_no_interval_and_a_factor_of_one_is_not_written() -> None:
    coef, covariance = np.array([[0.0, 0.5], [1.0, 0.0], [0.0, 2.0]]), np.diag([0.0, 0.25, 0.0])
    model = SparseModel(named_terms(["x", "g"], ["1", "x*g", "x"]), ["x", "g"], coef)
    model = replace(model, covariance=covariance)
    first, second, _ = str(model).splitlines()
    assert first.startswith("x' = x g [")
    assert second.startswith("g' = 0.5 (±0.98) + 2 x [")
    shown = re.sub("<[^>]*>", "", model._repr_html_()).splitlines()
    assert shown[0].startswith("dx/dt=xg &nbsp;")
    assert shown[1].startswith("dg/dt=0.5(±0.98) +2x &nbsp;")
    (table,) = interval_table(model)
    assert table.rows["95 % from"].tolist() == ["known", "-0.48", "known"]
    assert f"{Equation('x', model.terms('x'))}" == "x' = x g"
    assert equation_text("x", {"1/x": 1.0, "1": -1.0}) == "x' = 1/x - 1"
