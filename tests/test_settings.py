"""Settings of the wrong kind are refused where they are given, with the way out."""

from collections.abc import Callable

import numpy as np
import pytest

import ep2sindy as ep

T = np.linspace(0.0, 3.0, 31)
X = np.column_stack([np.exp(-T), np.sin(T)])
RUN = ep.Trajectory(T, X, ["x", "y"])
LIBRARY = ep.polynomial(["x", "y"], degree=2)
ROWS = ep.Regression(bootstraps=ep.Bootstraps(n=2))

TEXTS = {
    "relations": lambda: ep.discover(RUN, LIBRARY, relations="x: x == 1"),
    "relations ": lambda: ep.estimate(RUN, LIBRARY, relations="x: x == 1"),
    "relations  ": lambda: ep.constraint(LIBRARY, {"x": ["x"]}, "x: x == 1"),
    "the terms of 'x'": lambda: ep.discover(RUN, LIBRARY, terms={"x": "x*y"}),
    "the terms of 'x' ": lambda: ep.estimate(RUN, LIBRARY, terms={"x": "x*y"}),
    "the support of 'x'": lambda: ep.constraint(LIBRARY, {"x": "x*y"}),
    "products": lambda: ep.polynomial(["x", "y"], degree=1, products="x*y"),
    "functions": lambda: ep.polynomial(["x", "y"], degree=1, functions="sin"),
    "variables": lambda: ep.polynomial("xy", degree=1),
    "variables ": lambda: ep.named_terms("xy", ["x", "y"]),
    "variables  ": lambda: ep.Library("xy", np.eye(2, dtype=np.int64)),
    "names": lambda: ep.named_terms(["x", "y"], "xy"),
    "states": lambda: ep.discovery.PointSearch("xy", LIBRARY, ROWS),
    "judged": lambda: ep.FreeRunScore(judged="x"),
    "exact_inputs": lambda: ep.Weak(exact_inputs="u"),
    "state_names": lambda: ep.Trajectory(T, X, "xy"),
    "input_names": lambda: ep.Trajectory(T, X[:, :1], ["x"], X[:, 1:], "u"),
}


@pytest.mark.parametrize("name", TEXTS)
def test_a_text_where_a_list_belongs_is_refused(name: str) -> None:
    call: Callable[[], object] = TEXTS[name]
    with pytest.raises(ValueError, match=rf"{name.strip()} must be a list: '.*' came; write \['"):
        call()
