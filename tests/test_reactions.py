"""Reactions of several bodies as roles: their factors, what is found, and nothing negative."""

import numpy as np
import pytest

import ep2sindy as ep
from tests import programs
from tests.models import model_of

ASSOCIATION = {
    "A": {"A*B": -2.0, "C": 0.5},
    "B": {"A*B": -2.0, "C": 0.5},
    "C": {"A*B": 2.0, "C": -0.5},
}
ENZYME = {  # E + S <-> C -> E + P
    "E": {"E*S": -3.0, "C": 1.8},
    "S": {"E*S": -3.0, "C": 1.0},
    "C": {"E*S": 3.0, "C": -1.8},
    "P": {"C": 0.8},
}
JOINING = ep.Roles(exchange=[("A + B", "C")], nonnegative=True)
CATALYSED = ep.Roles(exchange=[("E + S", "C"), ("C", "E + P")], nonnegative=True)


def record(equations: dict, start: tuple, end_s: float, noise: float, seed: int) -> ep.Trajectory:
    """A run of 400 samples with white noise, as a fraction of each state's RMS."""
    t = np.linspace(0.0, end_s, 400)
    path = model_of(equations).simulate(t, np.array(start)).states
    size = noise * np.sqrt(np.square(path).mean(axis=0))
    return ep.Trajectory(
        t, path + size * np.random.default_rng(seed).normal(size=path.shape), list(equations)
    )


def processes(roles: ep.Roles, states: str) -> list:
    """Role, term and factors by state of every process of products of two."""
    names = states.split()
    return [
        (p.role, p.term, {state: factor for (state, _), factor in p.factors.items()})
        for p in roles.processes(ep.polynomial(names, degree=2), names)
    ]


def test_a_reaction_takes_from_all_that_react_and_gives_to_all_that_come():
    assert processes(JOINING, "A B C") == [
        ("A + B to C", "A*B", {"A": -1.0, "B": -1.0, "C": 1.0}),
        ("C to A + B", "C", {"A": 1.0, "B": 1.0, "C": -1.0}),
        ("C to A + B", "A*C", {"A": 1.0, "B": 1.0, "C": -1.0}),
        ("C to A + B", "B*C", {"A": 1.0, "B": 1.0, "C": -1.0}),
        ("C to A + B", "C^2", {"A": 1.0, "B": 1.0, "C": -1.0}),
    ]


def test_a_body_counts_as_often_as_it_stands_on_a_side():
    roles = ep.Roles(exchange=[("A + X", "X + X"), ("X + X", "D")], nonnegative=True)
    found = processes(roles, "A X D")
    # X^2 goes back to A + X; a catalyst that comes out as it went in has no factor.
    assert found[0] == ("A + X to X + X", "A*X", {"A": -1.0, "X": 1.0})
    assert ("X + X to D", "X^2", {"X": -2.0, "D": 1.0}) in found
    catalyst = ep.Roles(exchange=[("A + E", "E + B")], nonnegative=True)
    assert processes(catalyst, "A B E")[0][2] == {"A": -1.0, "B": 1.0}


def test_bad_reactions_say_what_must_hold():
    with pytest.raises(ValueError, match=r"sides such as 'A \+ B'.*\('A \+ B', 'B \+ A'\)"):
        ep.Roles(exchange=[("A + B", "B + A")])
    with pytest.raises(ValueError, match=r"must name states, got \['Q'\]"):
        processes(ep.Roles(exchange=[("A + Q", "B")]), "A B")


@pytest.mark.parametrize("noise", [0.0, 0.05])
@pytest.mark.parametrize(
    ("equations", "start", "end_s", "roles"),
    [
        (ASSOCIATION, (1.0, 0.6, 0.0), 6.0, JOINING),
        (ENZYME, (0.6, 1.5, 0.0, 0.0), 12.0, CATALYSED),
    ],
    ids=["association", "enzyme"],
)
def test_a_closed_network_is_found_and_conserves(equations, start, end_s, roles, noise):
    """E + C and A + C are constant, so that two states tell the same without roles."""
    run = record(equations, start, end_s, noise, 1)
    found = ep.discover(run, ep.polynomial(list(equations), degree=2).with_roles(roles))
    for state, terms in equations.items():
        assert found.model.terms(state) == pytest.approx(terms, rel=noise or 1e-6)
    rates = found.model.coef / np.abs(found.model.coef).max()
    first, other = (found.model.states.index(state) for state in (next(iter(equations)), "C"))
    np.testing.assert_allclose(rates[:, first] + rates[:, other], 0.0, atol=1e-15)


def test_a_state_that_starts_at_zero_is_estimated_on_the_model_s_path():
    """This noise would have C start below zero."""
    run = record(ASSOCIATION, (1.0, 0.6, 0.0), 6.0, 0.05, 1)
    found = ep.estimate(run, ep.polynomial(["A", "B", "C"], degree=2).with_roles(JOINING))
    (path,) = found.paths
    assert path.min() == path[0, 2] == 0.0
    again = found.model.simulate(run.t, path[0]).states
    np.testing.assert_allclose(again, path, atol=1e-3 * found.noise_std.min())


def test_a_config_tells_roles(tmp_path):
    record(ASSOCIATION, (1.0, 0.6, 0.0), 6.0, 0.01, 0).to_dataframe().to_csv(tmp_path / "run.csv")
    given = (
        "+exp=discover", "data=recognised", f"data.path={tmp_path / 'run.csv'}",
        "trajectory.states=[A,B,C]", "forecasts=0", f"output={tmp_path}",
    )  # fmt: skip
    roles = "roles={_target_: ep2sindy.Roles, exchange: [['A + B', C]], nonnegative: true}"
    found = programs.computed(programs.composed(*given, roles))
    terms = found.summary["models"]["model"]["equations"]
    assert terms["A"] == pytest.approx(terms["B"])
    assert terms["A"] == pytest.approx({term: -coef for term, coef in terms["C"].items()})
    assert list(terms["C"]) == ["C", "A*B"]
