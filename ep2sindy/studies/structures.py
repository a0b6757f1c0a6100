"""Structures of models that a config gives: terms with relations, roles, or coefficients."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import reduce
from operator import add
from typing import Annotated

import numpy as np

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import Library, named_terms, polynomial
from ep2sindy.library.relations import Constraint, constraint
from ep2sindy.library.roles import Roles, constraint_of, process_matrix, sum_known
from ep2sindy.library.terms import variables_of
from ep2sindy.model.model import SparseModel, model_of
from ep2sindy.studies.processes import Zones, compared_processes, ends_of, fit_roles
from ep2sindy.studies.study import Check, Coefficients, Terms

ROLES_DEGREE = 3  # of the products that roles are played by


def terms_of(
    given: Terms, *, states: Sequence[str], key: str = "model"
) -> tuple[Library, dict[str, list[str]]]:
    """The terms of every state, and a library that holds each of them once.

    key: the config's key for this model, for error messages.
    """
    if set(given) != set(states) or not all(given.values()):
        got = {state: list(names) for state, names in given.items()}
        raise ValueError(
            f"{key} must list the terms of every state of {list(states)}, such as "
            f"{{x: [x, x*y]}}: got {got}"
        )
    terms = {state: [str(name) for name in given[state]] for state in states}
    factors = [
        variable for names in terms.values() for name in names for variable in variables_of(name)
    ]
    variables = list(dict.fromkeys([*states, *factors]))
    named = reduce(add, (named_terms(variables, names) for names in terms.values()))
    return named.take(np.argsort(named.degrees, kind="stable")), terms


@dataclass(frozen=True)
class Structure:
    """What a model is made of.

    terms: of every state, with relations between their coefficients; or roles, whose terms move
    what states exchange. coefficients: in SI, of a model that is given as it is. fits: the ways of
    fitting that it takes part in; None means all. source: who proposed it.
    Raises ValueError unless exactly one of terms, roles and coefficients is given.
    """

    terms: Terms = field(default_factory=dict)
    relations: Sequence[str] = ()
    roles: Roles | None = None
    coefficients: Coefficients = field(default_factory=dict)
    fits: Sequence[str] | None = None
    source: str = ""

    def __post_init__(self) -> None:
        if sum(map(bool, (self.terms, self.roles, self.coefficients))) != 1:
            raise ValueError(
                "a structure is given by terms, by roles or by coefficients, one of them: got "
                f"{self}"
            )

    def library(self, name: str, states: Sequence[str]) -> Library:
        """The library of its terms. name: in the config, for errors."""
        if self.roles is not None:
            return polynomial(list(states), degree=ROLES_DEGREE)
        given: Terms = self.terms or {s: list(terms) for s, terms in self.coefficients.items()}
        return terms_of(given, states=states, key=f"models.{name}.terms")[0]

    def constraint(
        self, library: Library, run: Trajectory, zones: Zones, *, relations: bool
    ) -> Constraint:
        """What its coefficients obey. relations: False leaves those between terms aside.

        Roles that are known take what the balances of the zones tell.
        """
        states = list(run.state_names)
        if self.roles is None:
            terms = {state: list(map(str, self.terms[state])) for state in states}
            return constraint(library, terms, self.relations if relations else ())
        rates = fit_roles(zones.balances, run)
        roles = self.roles.with_known({name: rate.terms for name, rate in rates.items()})
        held = constraint_of(
            library, states, roles.processes(library, states), roles.known_processes
        )
        if held is None:
            raise ValueError(f"the coefficients of {states} do not tell these roles apart: {roles}")
        return held

    def given(self, library: Library, run: Trajectory) -> SparseModel:
        """The model of the coefficients that are given."""
        return model_of(library, self.coefficients, units=run.units)


Structures = Annotated[
    Mapping[str, Structure],
    Check(
        "like {name: {terms: {x: [x, x*y]}, relations: [..]}}",
        lambda value: isinstance(value, dict) and bool(value),
    ),
]


def balance_model(library: Library, held: Constraint, run: Trajectory, zones: Zones) -> SparseModel:
    """The model whose processes are least squares on the recorded balance.

    Raises ValueError for a constraint without processes, or a process that is not recorded.
    """
    empty = model_of(library, {state: {} for state in held.states}, units=run.units)
    processes = compared_processes(empty, held, run, zones) if held.processes else []
    found = {(p.ends, term): v for p in processes for term, v in p.counterpart.items()}
    asked = [(ends_of(process), process.term) for process in held.processes]
    if not asked or not {*asked} <= {*found}:
        raise ValueError(
            "coefficients of the balance need processes that the record tells, by roles: asked for "
            f"{asked}, the record tells {[*found]}; take roles, and the zone of a simulated "
            "thruster from its anode on"
        )
    values = [found[each] for each in asked]
    known, places = sum_known(held.known), [held.coefficients[k] for k in held.free]
    z = process_matrix(held) @ np.array(values) + [known.get(place, 0.0) for place in places]
    return model_of(library, held.equations(z), units=run.units)
