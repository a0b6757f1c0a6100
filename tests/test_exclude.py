"""Terms that an equation may not have: every search, hidden states, a config, and the errors."""

import re

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.discovery.discover import discover
from ep2sindy.estimation.hidden import entrances
from tests import programs

RUN = ep.lotka_volterra().trajectory(noise=0.01, rng=0).window(0, 250)
LIBRARY = ep.polynomial(["x", "y"], degree=2)
SEARCHES = [
    None,
    ep.Regression(search=ep.BestSubset(max_terms=6)),
    ep.Regression(search=ep.AdaptiveLasso()),
    ep.Regression(search=ep.STLSQ()),
    ep.Regression(search=ep.BestSubset(max_terms=3), bootstraps=ep.Bootstraps(n=4)),
]


@pytest.mark.parametrize("method", SEARCHES)
def test_no_candidate_has_an_excluded_term(method: ep.Regression | None) -> None:
    """Also one that the law needs, and by another order of its factors."""
    found = discover(RUN, LIBRARY, method, exclude={"x": ["y*x", "x^2"]})
    for candidate in found.fronts["x"].candidates:
        assert not {"x*y", "x^2"} & set(candidate.terms)
    assert {"x*y", "x^2"} & {name for c in found.fronts["y"].candidates for name in c.terms}


@pytest.mark.parametrize("method", SEARCHES[:2])
def test_what_is_left_is_found_as_from_a_library_without_the_term(
    method: ep.Regression | None,
) -> None:
    without = LIBRARY.take(np.array([name != "x^2" for name in LIBRARY.names]))
    of_all = {"x": ["x^2"], "y": ["x^2"]}
    excluded = discover(RUN, LIBRARY, method, exclude=of_all).model
    smaller = discover(RUN, without, method).model
    for state in ("x", "y"):
        assert excluded.terms(state) == pytest.approx(smaller.terms(state), rel=1e-8)


def test_a_hidden_state_enters_by_no_excluded_term() -> None:
    library = ep.polynomial(["x", "y", "z"], degree=2)
    ways = {(way.state, way.term) for (way,) in entrances(library, ["x", "y"], ["z"], ())}

    def allowed(state: str) -> np.ndarray:
        return np.array([(state, name) != ("x", "z") for name in library.names])

    left = {(w.state, w.term) for (w,) in entrances(library, ["x", "y"], ["z"], (), allowed)}
    assert ways - left == {("x", "z")}


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"terms": {"x": {"x": 0.6667}}}, r"relations=\['x: x == 0.6667'\]"),
        ({"terms": {"x": "x"}}, r"the terms of 'x' must be a list: 'x' came; write \['x'\]"),
        ({"terms": ["x"]}, r"terms must be lists of terms by state, .*: \['x'\] came"),
        ({"exclude": {"x": [1]}}, "exclude must hold names .*: 1 came for 'x'; the constant"),
        ({"exclude": {"z": ["x"]}}, r"unknown state 'z'; there are \['x', 'y'\]"),
        ({"relations": ["z: x == 1"]}, r"unknown state 'z'; there are \['x', 'y'\]"),
        ({"terms": {"x": []}}, r"an equation whose terms are given must have some: \['x'\]"),
        ({"terms": {"x": ["y"]}, "relations": ["x: x == 1"]}, "is not in the support of"),
        ({"exclude": {"x": ["x^3"]}}, r"unknown term 'x\^3'; this library has \["),
        ({"exclude": {"x": LIBRARY.names}}, "exclude must leave terms to every .* all 6 of the"),
        (
            {"exclude": {"x": ["x"]}, "terms": {"x": ["x", "x*y"]}},
            "a term is excluded, or it is named in terms and relations: 'x' of 'x' came in both",
        ),
        (
            {"exclude": {"x": ["x"]}, "roles": ep.Roles(outflow=["x"], inflow={"y": 1.0})},
            "relations, terms or exclude came as well; give roles alone",
        ),
    ],
)
def test_terms_that_cannot_be_known_or_excluded_are_refused(settings: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        discover(RUN, LIBRARY, **settings)


def test_a_config_excludes_terms(tmp_path) -> None:
    RUN.to_dataframe().to_csv(tmp_path / "run.csv")
    given = (
        "+exp=discover", "data=recognised", f"data.path={tmp_path / 'run.csv'}",
        "trajectory.states=[x,y]", "forecasts=0", f"output={tmp_path}",
    )  # fmt: skip
    found = programs.computed(programs.composed(*given, 'exclude={x: [1, "x^2"]}'))
    front = found.report.tables["front_model"]
    texts = front.loc[front["equation"] == "x", "text"].str.removeprefix("x' = ")[1:]
    terms = {part.lstrip("-0123456789.e ") for text in texts for part in re.split(" [+-] ", text)}
    assert terms == {"x", "y", "x y", "y^2"}
    with pytest.raises(ValueError, match="exclude.x must be a list: 'x' came"):
        programs.computed(programs.composed(*given, "exclude={x: x}"))
    with pytest.raises(ValueError, match="exclude goes without living, .* take .exp=discover"):
        programs.computed(programs.composed("+exp=breathing", "+exclude={n_i: [n_i]}"))
