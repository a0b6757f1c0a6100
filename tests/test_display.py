"""Objects that a person can read: one screen at most, the equations in it, HTML escaped."""

import numpy as np

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import Library, polynomial
from ep2sindy.model.model import SparseModel


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
    assert "&lang;<i>i</i> <i>j</i>&rang;" in found
    assert "<b>" not in found
    assert "<u>" not in found
    t = np.arange(3.0)
    run = Trajectory(t=t, states=t[:, None], state_names=["<i*j>"], label="<script>")
    assert "<i" not in (run._repr_html_() + model.library._repr_html_()).replace("<i>", "")
    assert "<script>" not in run._repr_html_()
