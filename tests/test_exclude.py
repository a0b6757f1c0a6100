"""Terms that an equation may not have: every search, hidden states, a config, and the errors."""

import re
from collections.abc import Callable

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.discovery.discover import discover
from ep2sindy.estimation.hidden import couplings
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
    found = discover(RUN, LIBRARY.exclude({"x": ["y*x", "x^2"]}), method)
    for candidate in found.fronts["x"].candidates:
        assert not {"x*y", "x^2"} & set(candidate.terms)
    assert {"x*y", "x^2"} & {name for c in found.fronts["y"].candidates for name in c.terms}


@pytest.mark.parametrize("method", SEARCHES[:2])
def test_what_is_left_is_found_as_from_a_library_without_the_term(
    method: ep.Regression | None,
) -> None:
    without = LIBRARY.take(np.array([name != "x^2" for name in LIBRARY.names]))
    of_all = {"x": ["x^2"], "y": ["x^2"]}
    excluded = discover(RUN, LIBRARY.exclude(of_all), method).model
    smaller = discover(RUN, without, method).model
    for state in ("x", "y"):
        assert excluded.terms(state) == pytest.approx(smaller.terms(state), rel=1e-8)


def test_a_hidden_state_enters_by_no_excluded_term() -> None:
    library = ep.polynomial(["x", "y", "z"], degree=2)
    ways = {(way.state, way.term) for (way,) in couplings(library, ["x", "y"], ["z"])}
    known = library.exclude({"x": ["z"]})
    left = {(w.state, w.term) for (w,) in couplings(known, ["x", "y"], ["z"])}
    assert ways - left == {("x", "z")}


@pytest.mark.parametrize(
    ("know", "message"),
    [
        (lambda: LIBRARY.only({"x": {"x": 0.6667}}), "a coefficient that is known is a relation"),
        (
            lambda: LIBRARY.exclude({"x": ["x^3"]}),
            r"unknown term 'x\^3'; this library has .*did you mean",
        ),
        (
            lambda: LIBRARY.exclude({"x": ["y*x"]}).only({"x": ["x", "x*y"]}),
            r"is excluded, or it is named in terms and relations, got 'x\*y' of 'x' in both",
        ),
    ],
)
def test_what_cannot_be_known_is_refused(know: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        know()


A, B = {"1": 2.0}, {"a": 3.0}
ROLES = ep.Roles(outflow=["x"])


@pytest.mark.parametrize(
    ("first", "second", "lines"),
    [
        (("known", {"x": {"x": A}}), ("known", {"x": {"x*y": B}, "y": {"y": A}}),
         ["x: x by the point", "x: x*y by the point", "y: y by the point"]),
        (("known", {"x": {"x": A}}), ("known", {"x": {"x": A}}), ["x: x by the point"]),
        (("known", {"x": {"x": A}}), ("known", {"x": {"x": B}}),
         r"coefficient x: x must be given once, got \{'1': 2.0\} and \{'a': 3.0\}"),
        (("only", {"x": ["x", "y"]}), ("only", {"x": ["y", "x"]}), ["x' has x, y"]),
        (("only", {"x": ["x"]}), ("only", {"y": ["y"]}), ["x' has x", "y' has y"]),
        (("only", {"x": ["x"]}), ("only", {"x": ["y"]}),
         r"the terms of 'x' must be given once, got \('x',\) and \('y',\)"),
        (("exclude", {"x": ["x^2"]}), ("exclude", {"x": ["x^2", "y"]}), ["x' has no x^2, y"]),
        (("relate", "x: x == 2 * y: y"), ("relate", "x:x == 2*y:y"), ["x: x == 2 * y: y"]),
        (("with_roles", ROLES), ("with_roles", ep.Roles(outflow=["x"])), [repr(ROLES)]),
        (("with_roles", ROLES), ("with_roles", ep.Roles(outflow=["y"])), "roles must be given"),
        (("with_roles", ROLES), ("with_roles", None), []),
        (("known", {"x": 2.0}), None, r"a sum of functions .*, got \{'x': 2.0\}"),
    ],
)  # fmt: skip
def test_what_is_known_twice_holds_once_or_is_refused(
    first: tuple, second: tuple | None, lines: list[str] | str
) -> None:
    def know() -> ep.Library:
        library = LIBRARY
        for how, what in [call for call in (first, second) if call]:
            library = getattr(library, how)(what)
        return library

    if isinstance(lines, list):
        assert know().facts.lines == lines
    else:
        with pytest.raises(ValueError, match=lines):
            know()


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
