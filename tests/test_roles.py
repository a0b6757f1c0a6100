"""Roles of terms: exact constraints, a search that conserves, mass action, and bad input."""

from dataclasses import replace

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.data.coerce import DiscoveryProblem
from ep2sindy.library.roles import constraint_of, process_amounts
from ep2sindy.operating.law import constrain_roles
from ep2sindy.selection.conserving import search_conserving_systems
from ep2sindy.selection.systems import TrialSystem, find_broken_demands

STATES = ["n_i", "n_n"]
LIBRARY = ep.polynomial(STATES, degree=2)
ROLES = ep.Roles(exchange=[("n_n", "n_i")], outflow=STATES, inflow={"n_n": 0.3})
# n_i' = r n_i n_n - a n_i + s n_n, n_n' = M - r n_i n_n - s n_n - b n_n: a focus.
R, A, S, B, M = 1.0, 1.0, 0.02, 0.05, 0.3


def balance(t: np.ndarray, noise: float = 0.0, seed: int = 0) -> ep.Trajectory:
    """A run of two states that exchange, leave and are supplied, in units of m^-3."""
    rate = R * np.array([[0, 0, 0, 0, 1.0, 0], [0, 0, 0, 0, -1.0, 0]])
    rate[0, 1], rate[0, 2], rate[1, 2], rate[1, 0] = -A, S, -S - B, M
    model = ep.SparseModel(LIBRARY, STATES, rate.T, dict.fromkeys(STATES, "m^-3"))
    path = model.simulate(t, np.array([0.2, 1.2])).states
    path = path + noise * np.random.default_rng(seed).normal(size=path.shape) * path.std(axis=0)
    return ep.Trajectory(t, path, STATES, units=model.units)


def processes(*chosen: tuple[str, str]) -> list:
    every = ROLES.processes(LIBRARY, STATES)
    return [p for pair in chosen for p in every if (p.role, p.term) == pair]


def test_every_role_has_its_terms_and_no_other():
    found = [(p.role, p.term, dict(p.factors)) for p in ROLES.processes(LIBRARY, STATES)]
    moved = [each for each in found if each[0] == "n_n to n_i"]
    assert [term for _, term, _ in moved] == ["n_i", "n_n", "n_i^2", "n_i*n_n", "n_n^2"]
    assert moved[3][2] == {("n_n", "n_i*n_n"): -1.0, ("n_i", "n_i*n_n"): 1.0}
    out = [each[1:] for each in found if each[0] == "n_i out"]
    assert out == [("n_i", {("n_i", "n_i"): -1.0}), ("n_i^2", {("n_i", "n_i^2"): -1.0})]
    assert {p.role for p in ROLES.processes(LIBRARY, STATES) if p.one_sign} == {
        "n_i out",
        "n_n out",
    }
    free = ep.Roles(inflow={"n_n": "free"}).processes(LIBRARY, STATES)
    assert [(p.role, p.term) for p in free if p.role.startswith("n_n")] == [("n_n in", "1")]
    assert [p.term for p in free if p.role == "n_i free"] == list(LIBRARY.names)
    named = ep.Roles(outflow={"n_n": ["n_n*n_i"]}).processes(LIBRARY, STATES)
    leaving = [(p.term, p.one_sign) for p in named if p.role == "n_n out"]
    assert leaving == [("n_i*n_n", False)]


def test_what_leaves_one_volume_fills_another_by_the_ratio_of_their_sizes():
    states, library = ["a", "b", "c"], ep.polynomial(["a", "b", "c"])
    roles = ep.Roles(exchange=[("a + a", "b + c", ["a^2"])], sizes={"a": 2.0, "b": 98.0})
    process = roles.processes(library, states)[0]
    moved = {"a": -2.0, "b": 2.0 / 98.0, "c": 2.0}  # a b and a c for two a
    assert process.factors == {(state, "a^2"): factor for state, factor in moved.items()}
    held = constraint_of(library, ["b", "a", "c"], [process])
    assert held.C.ravel().tolist() == [1.0, -98.0, 98.0]  # 2 / (2 / 98) is 98.00000000000001


def test_the_constraint_is_that_of_the_processes():
    chosen = processes(("n_n to n_i", "n_i*n_n"), ("n_n to n_i", "n_i"), ("n_i out", "n_i"))
    held = constraint_of(LIBRARY, STATES, chosen, ep.Roles(inflow={"n_n": 7.0}).known_processes)
    assert held.coefficients == (
        ("n_i", "n_i"), ("n_i", "n_i*n_n"), ("n_n", "1"), ("n_n", "n_i"), ("n_n", "n_i*n_n"),
    )  # fmt: skip
    z = np.array([-3.0, 2.0, 1.5])  # of n_i: n_i, n_i: n_i n_n, and what n_i gives back to n_n
    assert held.coef(z).tolist() == [-3.0, 2.0, 7.0, 1.5, -2.0]
    assert set(held.C.ravel()) <= {-1.0, 0.0, 1.0}


def test_processes_that_no_coefficients_tell_apart_make_no_system():
    twice = processes(("n_n to n_i", "n_i"), ("n_i out", "n_i"))
    spare = ep.Roles(outflow={"n_n": ["n_i"]}).processes(LIBRARY, STATES)[:1]
    assert constraint_of(LIBRARY, STATES, twice) is not None
    assert constraint_of(LIBRARY, STATES, [*twice, *spare]) is None


def test_systems_of_the_same_terms_differ_by_their_roles():
    """Ions leave by n_i or by n_i^2; the terms of both equations are the same."""
    shared = [("n_n to n_i", term) for term in ("n_i*n_n", "n_i", "n_i^2")]
    places, parts = [], []
    for leaving in ("n_i", "n_i^2"):
        held = constraint_of(LIBRARY, STATES, processes(*shared, ("n_i out", leaving)), [])
        places.append(held.coefficients)
        empty = ep.SparseModel(LIBRARY, STATES, np.zeros((len(LIBRARY), 2)))
        parts.append(TrialSystem(empty, held).parts)
    assert places[0] == places[1]
    exchanged = ("n_i*n_n", "n_i", "n_i^2")
    assert parts[0] == {"n_n to n_i": exchanged, "n_i out": ("n_i",)}
    assert parts[1] == {"n_n to n_i": exchanged, "n_i out": ("n_i^2",)}


@pytest.fixture(scope="module")
def record() -> ep.Trajectory:
    return balance(np.linspace(0.0, 40.0, 2001))


def refined(max_terms: int) -> ep.Regression:
    """A search whose systems are refined and assessed whole."""
    search = ep.BestSubset(max_terms=max_terms, n_best=60)
    return ep.Regression(search=search, selection=ep.FreeRunScore(bounds=None), depth=6)


def test_a_search_under_roles_finds_the_truth_and_conserves(record):
    found = ep.discover(record, LIBRARY.with_roles(ROLES), refined(4))
    assert found.model.terms("n_i") == pytest.approx({"n_i": -A, "n_n": S, "n_i*n_n": R}, rel=1e-3)
    neutrals = {"1": M, "n_n": -S - B, "n_i*n_n": -R}
    assert found.model.terms("n_n") == pytest.approx(neutrals, rel=1e-3)
    assert found.model.terms("n_n")["1"] == M  # known: exact
    assert found.model.terms("n_n")["n_i*n_n"] == -found.model.terms("n_i")["n_i*n_n"]
    assert len(found.constraint.free) == 4
    for state in STATES:
        assert tuple(found.model.terms(state)) == found.chosen[state].terms
    again = ep.refine(found.model, [record], constraint=found.constraint, seed=0)
    assert again.model.terms("n_n")["n_i*n_n"] == -again.model.terms("n_i")["n_i*n_n"]


MASS_ACTION = replace(ROLES, nonnegative=True)


def test_mass_action_takes_terms_that_contain_what_they_lower():
    found = [(p.role, p.term) for p in MASS_ACTION.processes(LIBRARY, STATES)]
    ahead = [term for role, term in found if role == "n_n to n_i"]
    assert ahead == ["n_n", "n_i*n_n", "n_n^2"]
    assert [term for role, term in found if role == "n_i to n_n"] == ["n_i", "n_i^2"]
    assert [term for role, term in found if role == "n_n out"] == ["n_n", "n_n^2"]
    assert all(p.one_sign for p in MASS_ACTION.processes(LIBRARY, STATES))
    apart = replace(MASS_ACTION, exchange=[("n_n", "n_i"), ("n_i", "n_n")])
    found = [(p.role, p.term) for p in apart.processes(LIBRARY, STATES)]
    assert [term for role, term in found if role == "n_n to n_i"] == ahead
    assert [term for role, term in found if role == "n_i to n_n"] == ["n_i", "n_i^2", "n_i*n_n"]
    named = replace(MASS_ACTION, outflow={"n_i": ["n_n*n_i"]})
    assert [p.term for p in named.processes(LIBRARY, STATES) if p.role == "n_i out"] == ["n_i*n_n"]
    with pytest.raises(ValueError, match=r"what lowers 'n_i' contains it, got \['n_n'\]"):
        replace(MASS_ACTION, outflow={"n_i": ["n_i", "n_n"]}).processes(LIBRARY, STATES)
    births = replace(MASS_ACTION, inflow={"n_n": ["n_n", "1"]})
    assert [p.term for p in births.processes(LIBRARY, STATES) if p.role == "n_n in"] == ["n_n", "1"]


def test_a_search_by_mass_action_proposes_positive_processes_alone(record):
    method = refined(4)
    found = ep.discover(record, LIBRARY.with_roles(MASS_ACTION), method)
    assert found.model.terms("n_i") == pytest.approx({"n_i": -A, "n_n": S, "n_i*n_n": R}, rel=1e-3)
    rows = ep.Differential().assemble([record], LIBRARY, rng=np.random.default_rng(0))
    proposed = []
    for roles in (MASS_ACTION, ROLES):
        task = DiscoveryProblem([record], LIBRARY.with_roles(roles))
        (own,) = search_conserving_systems([(task, rows)], method.search, depth=50)
        proposed.append(own.systems)
    systems, free = proposed
    assert len(systems) > 4
    assert not any(system.broken(system.model) for system in systems)
    amounts = [amount for system in free for _, amount in amounts_of(system)]
    assert min(amounts) < 0.0  # without mass action some are negative


def test_broken_demands_are_named():
    chosen = processes(
        ("n_n to n_i", "n_i*n_n"), ("n_n to n_i", "n_i"), ("n_i out", "n_i"), ("n_n out", "n_n")
    )  # fmt: skip
    chosen.append(replace(chosen[1], role="n_n free"))
    means = np.array([1.0, 4.0, 1.0, 1.0, 1.0])
    for values, broken in (
        ([2.0, -0.25, 1.0, 1.0, -1.0], []),
        ([2.0, -0.5, 1.0, 1.0, -1.0], ["n_n to n_i > 0 in the mean"]),
        ([2.0, 1.0, 0.0, 1.0, 1.0], ["n_i out by n_i > 0", "n_i out > 0 in the mean"]),
    ):
        assert find_broken_demands(chosen, np.array(values), means) == broken
        assert find_broken_demands(chosen, np.array(values), None) == broken[: len(broken) - 1]


def amounts_of(found) -> list:
    return process_amounts(found.constraint, {s: found.model.terms(s) for s in STATES})


def test_what_is_stated_is_kept_next_to_what_is_found(record):
    """n_n leaves by S + B, stated as an outflow and a seed: only the seed is to be found."""
    known = {"n_n out": {"n_n": B}, "n_n in": {"1": M}, "n_i out": {"n_i": A}}
    roles = ep.Roles(
        exchange=[("n_n", "n_i")], outflow={"n_n": "known", "n_i": "known or free"},
        inflow={"n_n": "known"}, nonnegative=True,
    )  # fmt: skip
    assert roles.open == ["n_n out", "n_i out", "n_n in"]
    method = refined(3)
    found = ep.discover(record, LIBRARY.with_roles(roles.with_known(known)), method)
    assert {(p.role, p.term) for p in found.constraint.processes} == {
        ("n_n to n_i", "n_n"), ("n_n to n_i", "n_i*n_n")
    }  # fmt: skip
    assert [amount for _, amount in amounts_of(found)][:2] == pytest.approx([S, R], rel=2e-3)
    assert [(p.role, amount) for p, amount in amounts_of(found)][2:] == [
        ("n_n out", B), ("n_i out", A), ("n_n in", M)
    ]  # fmt: skip
    assert found.model.terms("n_n")["n_n"] == pytest.approx(-S - B, rel=1e-3)
    assert found.model.terms("n_i")["n_i"] == -A


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ep.Roles(inflow={"x": "some"}), "must be a number in SI per second, a list"),
        (lambda: ep.Roles(outflow={"x": {"x": "fast"}}), "terms with their coefficients in SI"),
        (lambda: ep.Roles(sizes={"x": 0.0}), "sizes must be positive numbers: x has 0.0"),
        (lambda: ep.Roles(sizes={"x": np.inf}), "sizes must be positive numbers: x has inf"),
        (
            lambda: ep.Roles(inflow={"n_n": "known"}).processes(LIBRARY, STATES),
            "known only where a record gives them",
        ),
        (
            lambda: ep.Roles(outflow=["n_i"], equations={"n_i": {"n_i": 1.0}}).processes(
                LIBRARY, STATES
            ),
            "roles or a known equation",
        ),
    ],
)
def test_bad_roles_say_what_must_hold(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": ep.TrajectorySearch(selection=ep.FreeRunScore())}, "keeps roles by likelihood"),
        ({"method": ep.Regression()}, "a rule must rank whole systems"),
    ],
)  # fmt: skip
def test_roles_that_cannot_be_kept_are_refused(record, options, message):
    with pytest.raises(ValueError, match=message):
        ep.discover(record, LIBRARY.with_roles(ROLES), **options)


def test_a_rule_of_single_equations_is_refused_at_several_points_too(record):
    runs = [
        replace(record, states=scale * record.states, parameters={"scale": scale})
        for scale in (1.0, 2.0)
    ]
    with pytest.raises(ValueError, match="a rule must rank whole systems"):
        ep.discover(runs, LIBRARY.with_roles(ROLES), ep.Regression(), shared=True)


def test_known_or_free_takes_what_there_is():
    either = ep.Roles(inflow={"n_n": "known or free"})
    assert either.with_known({"n_n in": {"1": 2.0}}).inflow == {"n_n": 2.0}
    assert either.with_known({}).inflow == {"n_n": "free"}


def test_a_known_equation_is_kept_and_its_terms_stand_in_no_other() -> None:
    roles = ep.Roles(outflow=["n_i"], equations={"n_n": {"n_i^2*n_n": 2.0, "1": -1.0}})
    library = ep.polynomial(["n_i"], degree=2)
    whole = library.with_roles(roles).with_known_terms(STATES)
    assert whole.names == (*library.names, "n_i^2*n_n")
    processes = roles.processes(library, STATES)
    assert [(p.role, p.term) for p in processes] == [("n_i out", "n_i"), ("n_i out", "n_i^2")]
    held = constraint_of(whole, STATES, processes[:1], roles.known_processes)
    assert held.coefficients == (("n_i", "n_i"), ("n_n", "1"), ("n_n", "n_i^2*n_n"))
    assert held.coef(np.array([-5.0])).tolist() == [-5.0, -1.0, 2.0]


def test_the_default_search_keeps_roles():
    """Prey that are born, and eaten by those whom they feed: two equations, three processes."""
    run = ep.lotka_volterra().trajectory(noise=0.05, rng=0)
    library = ep.polynomial(["x", "y"], degree=2)
    roles = ep.Roles(exchange=[("x", "y")], outflow=["y"], inflow={"x": ["x"]}, nonnegative=True)
    found = ep.discover(run, library.with_roles(roles))
    assert {(p.role, p.term) for p in found.constraint.processes} == {
        ("x to y", "x*y"), ("y out", "y"), ("x in", "x")
    }  # fmt: skip
    eaten = -found.model.terms("x")["x*y"]
    assert found.model.terms("y")["x*y"] == pytest.approx(eaten, rel=1e-14)
    turned = replace(run, states=run.states * [1.0, -1.0])
    with pytest.raises(ValueError, match="nonnegative roles need states that are concentrations"):
        ep.discover(turned, library.with_roles(roles))


def test_the_default_search_keeps_what_is_known():
    run = ep.lotka_volterra().trajectory(noise=0.02, rng=0)
    library = ep.polynomial(["x", "y"], degree=2)
    roles = ep.Roles(
        exchange=[("x", "y", ["x*y"])], outflow={"y": {"y": 1 / 3}}, inflow={"x": ["x"]},
        nonnegative=True,
    )  # fmt: skip
    found = ep.estimate(run, library.with_roles(roles))
    assert found.model.terms("y")["y"] == pytest.approx(-1 / 3, rel=1e-12)
    assert [(p.role, p.term) for p in found.constraint.known] == [("y out", "y")]


def test_an_inflow_by_functions_of_the_point_is_exact_at_every_point_and_in_the_law(record):
    by_point = replace(ROLES, inflow={"n_n": {"1": 0.1, "m": 2.0}})
    library, chosen = LIBRARY.with_roles(by_point), processes(
        ("n_n to n_i", "n_i*n_n"), ("n_i out", "n_i"), ("n_n out", "n_n")
    )  # fmt: skip
    points = np.array([[1.0], [3.0]])
    held = constrain_roles(LIBRARY, STATES, chosen, by_point, parameters=["m"])
    for (m,), own in zip(points, held.at(points), strict=True):
        roles = replace(ROLES, inflow={"n_n": 0.1 + 2.0 * m})
        assert library.at_operating_point({"m": m}).facts.roles == roles
        there = constraint_of(LIBRARY, STATES, chosen, roles.known_processes)
        assert (own.coefficients, own.processes) == (there.coefficients, there.processes)
        assert own.known == there.known
        assert [own.C.tolist(), own.d.tolist()] == [there.C.tolist(), there.d.tolist()]
    model = ep.SparseModel(LIBRARY, STATES, np.zeros((len(LIBRARY), 2)))
    line = ep.polynomial(["m"], degree=1)
    law = held.make_law(model, line, points, np.full((3, 2), 0.7), how="rows")
    assert law.numbers["n_n"]["1"] == {"1": 0.1, "m": 2.0}
    assert law.numbers["n_n"]["n_i*n_n"] == {"1": -0.7, "m": -0.7}
    assert law.provenance["exact"] == "n_n: 1 == 0.1 + 2.0 * m"
    with pytest.raises(ValueError, match="needs runs that have one"):
        by_point.processes(LIBRARY, STATES)
    with pytest.raises(ValueError, match=r"n_n in must be a sum of functions of \[\]"):
        ep.discover(record, library, refined(3))


def test_systems_of_several_points_come_in_one_order():
    """Of one point twice the order is that point's; every point has amounts of its own."""
    asked, scales = [], (1.0, 1.5)
    for scale in scales:
        run = balance(np.linspace(0.0, 40.0, 1001), noise=0.02)
        run = replace(run, states=run.states * scale)
        roles = replace(MASS_ACTION, inflow={"n_n": 0.3 * scale})
        rows = ep.Differential().assemble([run], LIBRARY, rng=np.random.default_rng(0))
        asked.append((DiscoveryProblem([run], LIBRARY.with_roles(roles)), rows))
    search = ep.BestSubset(max_terms=4, n_best=60)
    (alone,), twice, both = (
        [own.systems for own in search_conserving_systems(points, search, depth=5)]
        for points in (asked[:1], asked[:1] * 2, asked)
    )

    def supports(systems):
        return [{(p.role, p.term) for p in each.constraint.processes} for each in systems]

    assert supports(alone) == supports(twice[0]) == supports(twice[1])
    assert supports(both[0]) == supports(both[1])
    true = {("n_n to n_i", t) for t in ("n_n", "n_i*n_n")} | {
        ("n_n out", "n_n"),
        ("n_i out", "n_i"),
    }
    for scale, own in zip(scales, both, strict=True):
        model = own[supports(own).index(true)].model
        assert model.terms("n_n")["1"] == 0.3 * scale
        assert model.terms("n_i")["n_i*n_n"] == pytest.approx(R / scale, rel=0.05)
