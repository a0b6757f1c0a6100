"""Roles of terms in equations of balance: what one state gives another, loses, or is supplied with.

A process is a term with its role. It may stand in several equations, with fixed factors, so that a
search takes it into all of them or into none, and what it moves is conserved.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np
from jaxtyping import Float

from ep2sindy.library.library import Library
from ep2sindy.library.names import VARIABLE
from ep2sindy.library.relations import Constraint
from ep2sindy.runtime.values import check_list

KNOWN, FREE, EITHER = "known", "free", "known or free"
_SIGN = re.compile(rf"\s*(?P<state>{VARIABLE})\s*:\s*(?P<term>\S.*?)\s*(?P<side>[<>])\s*0\s*")

Place = tuple[str, str]  # (state, term)


@dataclass(frozen=True)
class Process:
    """One term in one role: its coefficient enters the equations with these factors.

    factors: (state, term) -> 1 or -1. one_sign: True if its coefficient must be positive.
    """

    role: str
    term: str
    factors: Mapping[Place, float]
    one_sign: bool = False


@dataclass(frozen=True)
class Roles:
    """Roles that terms have, for a search that conserves what states exchange.

    Every role is played by a term or more.
    exchange: pairs (from, to); a term in this role leaves the first equation and enters the second
    with the same coefficient, which may be negative. outflow: states that lose something to the
    outside, by terms of their own powers, each of which takes away; or state -> the terms that may.
    inflow: state -> the constant that it is supplied with, in SI per second; "free" if it is to be
    found. An experiment also takes "known", the inflow that the record itself gives, and "known or
    free". signs: demanded of coefficients, such as "n_i: n_i < 0". A state without a role has an
    equation of free terms.
    Raises ValueError for an exchange of a state with itself, or a sign that cannot be read.

    >>> roles = ep.Roles(exchange=[("prey", "predator")], outflow=["predator"])
    >>> library = ep.polynomial(["prey", "predator"], degree=2)
    >>> [process.term for process in roles.processes(library, ["prey", "predator"])][-2:]
    ['predator', 'predator^2']
    """

    exchange: Sequence[Sequence[str]] = ()
    outflow: Sequence[str] | Mapping[str, Sequence[str]] = ()
    inflow: Mapping[str, float | str] = field(default_factory=dict)
    signs: Sequence[str] = ()

    def __post_init__(self) -> None:
        check_list("exchange", self.exchange)
        check_list("signs", self.signs)
        for pair in self.exchange:
            if isinstance(pair, str) or len(pair) != 2 or pair[0] == pair[1]:
                raise ValueError(f"an exchange joins two states, (from, to): {pair!r} came")
        if not isinstance(self.outflow, Mapping):
            check_list("outflow", self.outflow)
        for state, value in self.inflow.items():
            if isinstance(value, str) and value in (KNOWN, FREE, EITHER):
                continue
            if isinstance(value, str | bool) or not np.isfinite(value):
                raise ValueError(
                    f"the inflow of {state} must be a number in SI per second, {KNOWN!r}, {FREE!r} "
                    f"or {EITHER!r}: {value!r} came"
                )
        for text in self.signs:
            parse_sign(text)

    @property
    def states(self) -> tuple[str, ...]:
        """Every state that has a role, once."""
        named = [state for pair in self.exchange for state in pair]
        signed = [parse_sign(text)[0][0] for text in self.signs]
        return tuple(dict.fromkeys([*named, *self.outflow, *self.inflow, *signed]))

    @property
    def signed(self) -> dict[Place, int]:
        """(state, term) -> 1 or -1, for every demanded sign."""
        return dict(map(parse_sign, self.signs))

    @property
    def known_inflow(self) -> dict[str, float]:
        """The inflows that are given as numbers, by state."""
        return {s: float(v) for s, v in self.inflow.items() if not isinstance(v, str)}

    def with_known(self, known: Mapping[str, float]) -> Roles:
        """These roles with a record's inflows in place of "known".

        Raises ValueError for a state whose inflow the record does not give.
        """
        for state in [s for s, value in self.inflow.items() if value == KNOWN]:
            if state not in known:
                raise ValueError(
                    f"the inflow of {state!r} is not known of this record, whose inflows are "
                    f"{dict(known)}: it follows from the mass flow, for the neutrals of a zone "
                    f"that begins at the anode of a simulated thruster; give it as a number, or "
                    f"{FREE!r}"
                )
        own = {s: known[s] if value == KNOWN else value for s, value in self.inflow.items()}
        own |= {s: known.get(s, FREE) for s, value in self.inflow.items() if value == EITHER}
        return Roles(self.exchange, self.outflow, own, self.signs)

    def processes(self, library: Library, states: Sequence[str]) -> list[Process]:
        """Every process that the library and these roles allow, in the equations of the states.

        Raises ValueError for a role of something that is no state, a term that the library lacks,
        or an inflow that is "known" but not yet given.
        """
        self._check(library, states)
        found = []
        terms = [name for name in library.names if name != "1"]
        for giver, taker in self.exchange:
            for term in terms:
                factors = {(giver, term): -1.0, (taker, term): 1.0}
                found.append(Process(f"{giver} to {taker}", term, MappingProxyType(factors)))
        for state in self.outflow:
            for term in self._leaving(state, library):
                factors = {(state, term): -1.0}
                found.append(
                    Process(f"{state} out", term, MappingProxyType(factors), one_sign=True)
                )
        for state in [s for s, value in self.inflow.items() if value == FREE]:
            found.append(Process(f"{state} in", "1", MappingProxyType({(state, "1"): 1.0})))
        roles = {state for pair in self.exchange for state in pair} | {*self.outflow, *self.inflow}
        for state in [s for s in states if s not in roles]:
            found += [
                Process(f"{state} free", term, MappingProxyType({(state, term): 1.0}))
                for term in library.names
            ]
        return found

    def _leaving(self, state: str, library: Library) -> list[str]:
        """The terms by which a state may flow out."""
        if isinstance(self.outflow, Mapping):
            return [library.names[library.index(term)] for term in self.outflow[state]]
        powers = re.compile(rf"{re.escape(state)}(\^\d+)?")
        return [name for name in library.names if powers.fullmatch(name)]

    def _check(self, library: Library, states: Sequence[str]) -> None:
        if unknown := [state for state in self.states if state not in states]:
            raise ValueError(
                f"roles must name states: {unknown} came, and the states are {list(states)}"
            )
        if open_ := [s for s, value in self.inflow.items() if value in (KNOWN, EITHER)]:
            raise ValueError(
                f"the inflow of {open_} is known only where a record gives it, as in the "
                f"experiments on a simulated thruster: give a number in SI per second, or {FREE!r}"
            )
        if self.known_inflow or FREE in self.inflow.values():
            library.index("1")
        for _, term in self.signed:
            library.index(term)


def parse_sign(text: str) -> tuple[Place, int]:
    """Read a demanded sign, `state: term < 0` or `> 0`; raises ValueError for anything else."""
    found = _SIGN.fullmatch(text)
    if found is None:
        raise ValueError(f"a sign is demanded as 'state: term < 0' or '... > 0': {text!r} came")
    return (found["state"], found["term"]), (1 if found["side"] == ">" else -1)


def constraint_of(
    library: Library,
    states: Sequence[str],
    processes: Sequence[Process],
    known: Mapping[str, float],
) -> Constraint | None:
    """The exact constraint of a model with these processes and known inflows.

    Returns None if the coefficients do not determine the processes, as with an exchange and the
    outflow of both states by one term.
    """
    places = {place for process in processes for place in process.factors}
    places |= {(state, "1") for state in known}
    order = sorted(places, key=lambda at: (states.index(at[0]), library.index(at[1])))
    shares = np.array([[p.factors.get(place, 0.0) for p in processes] for place in order])
    fixed = np.array([known.get(s, 0.0) if term == "1" else 0.0 for s, term in order])
    free = _independent_rows(shares)
    if len(free) < len(processes):
        return None
    # Factors are 1, -1 and 0 and so is the result: rounding removes what the inverse adds.
    C = np.rint(shares @ np.linalg.inv(shares[free])) + 0.0
    return Constraint(tuple(states), tuple(order), C, fixed - C @ fixed[free], free)


def _independent_rows(matrix: Float[np.ndarray, "rows columns"]) -> np.ndarray:
    """Indices of the first rows that are linearly independent of those before them."""
    found: list[int] = []
    for k in range(len(matrix)):
        if np.linalg.matrix_rank(matrix[[*found, k]]) > len(found):
            found.append(k)
    return np.array(found, dtype=np.int64)
