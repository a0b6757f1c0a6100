"""Equations by process: common factors, signs and digits, in text, LaTeX and HTML."""

import re
from dataclasses import replace

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.library.equations import equation_html, equation_text, terms_latex
from ep2sindy.library.roles import constraint_of, groups_of

STATES = ["n_i", "n_n"]
LIBRARY = ep.polynomial(STATES, degree=3)
ROLES = ep.Roles(
    exchange=[("n_n", "n_i", ["n_i^2*n_n", "n_i*n_n^2"])],
    outflow={"n_i": ["n_i", "n_i^2"], "n_n": ["n_n"]},
    inflow={"n_n": 2.31e23},
    nonnegative=True,
)
LAW = {
    "n_i": {"n_i": -3.64e5, "n_i^2": -8.45e-14, "n_i^2*n_n": 1.62e-32, "n_i*n_n^2": 3.12e-33},
    "n_n": {"1": 2.31e23, "n_n": -2760.0, "n_i^2*n_n": -1.62e-32, "n_i*n_n^2": -3.12e-33},
}


def held_by(roles: ep.Roles):
    return constraint_of(LIBRARY, STATES, roles.processes(LIBRARY, STATES), roles.known_processes)


def texts(roles: ep.Roles, coef, **options) -> list[str]:
    groups = groups_of(held_by(roles), coef, **options)
    return [equation_text(state, found) for state, found in groups.items()]


def test_the_law_is_written_by_process() -> None:
    assert texts(ROLES, LAW) == [
        "n_i' = n_i n_n (1.62e-32 n_i + 3.12e-33 n_n) - n_i (3.64e+05 + 8.45e-14 n_i)",
        "n_n' = 2.31e+23 - n_i n_n (1.62e-32 n_i + 3.12e-33 n_n) - 2.76e+03 n_n",
    ]
    faster = texts(ROLES, LAW, per=1e-6)
    assert faster[1] == "n_n' = 2.31e+17 - n_i n_n (1.62e-38 n_i + 3.12e-39 n_n) - 0.00276 n_n"
    width = {"n_i": {"n_i": 1e4}, "n_n": {"n_n": 50.0}}
    assert texts(ROLES, LAW, reach=width)[0].endswith("- n_i (3.64e+05 (±1e+04) + 8.45e-14 n_i)")


def test_latex_and_pages_say_the_same() -> None:
    groups = groups_of(held_by(ROLES), LAW)
    first, last = terms_latex(groups["n_i"])
    assert first == (
        r"n_{i} \, n_{n} \, (1.62 \cdot 10^{-32} \, n_{i} + 3.12 \cdot 10^{-33} \, n_{n})"
    )
    assert last == r"- n_{i} \, (3.64 \cdot 10^{5} + 8.45 \cdot 10^{-14} \, n_{i})"
    page = equation_html("n_n", groups["n_n"])
    shown = re.sub(r"<[^>]*>|[\s\u2009]", "", page)
    assert shown == "dnn/dt=2.31·1023−ninn(1.62·10−32ni+3.12·10−33nn)−2.76·103nn"
    assert page.count("<math ") == 3  # what enters, what is exchanged, what leaves
    assert page.count("(") == page.count(")") == 1


def test_signs_are_those_of_the_coefficients() -> None:
    """An exchange that goes back, one of both signs, and a term stated next to one found."""
    roles = replace(
        ROLES,
        exchange=[("n_n", "n_i", ["n_i*n_n", "n_n"]), ("n_i", "n_n", {"n_i": 1e5})],
        outflow={"n_i": ["n_i"], "n_n": {"n_n": 3e3, "n_i*n_n": 2e-16}},
        nonnegative=False,
    )
    coef = {
        "n_i": {"n_i": -5e5, "n_n": -2.0, "n_i*n_n": 4e-14},
        "n_n": {"1": 2.31e23, "n_i": 1e5, "n_n": 2.0 - 3e3, "n_i*n_n": -4e-14 - 2e-16},
    }
    assert texts(roles, coef) == [
        "n_i' = n_n (4e-14 n_i - 2) - 1e+05 n_i - 4e+05 n_i",
        "n_n' = 2.31e+23 - n_n (4e-14 n_i - 2) + 1e+05 n_i - n_n (3e+03 + 2e-16 n_i)",
    ]
    back = {s: {t: -v for t, v in terms.items()} for s, terms in LAW.items()}
    assert texts(ROLES, back)[0].startswith("n_i' = -n_i n_n (1.62e-32 n_i + 3.12e-33 n_n) + n_i (")


def test_a_small_zone_gives_a_large_one_less() -> None:
    zones = {"a": 1.0, "b": 2.0}
    roles = ep.Roles(exchange=[("n_n", "n_i")], outflow=STATES, inflow={"n_n": 3.0}).in_zones(zones)
    names = [f"{s}@{z}" for z in zones for s in STATES]
    library = ep.polynomial(names, degree=3)
    chosen = {}
    for process in roles.processes(library, names):
        chosen.setdefault(process.role, process)
    held = constraint_of(library, names, [*chosen.values()], roles.known_processes)
    free = [held.coefficients[k][0] for k in held.free]
    coef = held.coef(np.array([1.0 if state.startswith("n_i") else -1.0 for state in free]))
    given = {s: {} for s in names}
    for (state, term), value in zip(held.coefficients, coef, strict=True):
        given[state][term] = value
    found = groups_of(held, given)
    for state in names:
        total: dict[str, float] = {}
        for group in found[state]:
            for term, value in group.terms.items():
                total[term] = total.get(term, 0.0) + group.sign * value
        assert total == pytest.approx({t: v for t, v in given[state].items() if v})
