"""Roles of terms in equations of balance: what one state gives another, loses, or is supplied with.

A process is a term with its role. It may stand in several equations, with fixed factors, so that a
search takes it into all of them or into none, and what it moves is conserved.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float

from ep2sindy.library.library import Library, library_of
from ep2sindy.library.names import VARIABLE
from ep2sindy.library.relations import Constraint, Place, Process
from ep2sindy.library.terms import read_term
from ep2sindy.runtime.values import check_list

KNOWN, FREE, EITHER = "known", "free", "known or free"
_SIGN = re.compile(rf"\s*(?P<state>{VARIABLE})\s*:\s*(?P<term>\S.*?)\s*(?P<side>[<>])\s*0\s*")


@dataclass(frozen=True)
class Roles:
    """Roles that terms have, for a search that conserves what states exchange.

    Every role is played by a term or more.
    exchange: pairs (from, to); a term in this role leaves the first equation and enters the second
    with the same coefficient, which may be negative. Any term may, or those of a third entry:
    (from, to, terms). outflow: states that lose something to the outside, by terms of their own
    powers, each of which takes away; or state -> the terms that may, of either sign.
    inflow: state -> the constant that it is supplied with, in SI per second; "free" if it is to be
    found. An experiment also takes "known", the inflow that the record itself gives, and "known or
    free". signs: demanded of coefficients, such as "n_i: n_i < 0". A state without a role has an
    equation of free terms. sizes: state -> length or volume that it is an average over; what leaves
    a small place changes a large one by less. Absent ones are one. forward: True if in the mean
    over the records every exchange moves more from the first state to the second than back, and
    every outflow takes away. equations: state -> terms with their coefficients in SI, where the
    equation is known and nothing is to be found; the library need not hold these terms.
    Raises ValueError for an exchange of a state with itself, a size that is not positive, a sign
    that cannot be read, or a role of a state whose equation is known.

    >>> roles = ep.Roles(exchange=[("prey", "predator")], outflow=["predator"])
    >>> library = ep.polynomial(["prey", "predator"], degree=2)
    >>> [process.term for process in roles.processes(library, ["prey", "predator"])][-2:]
    ['predator', 'predator^2']
    """

    exchange: Sequence[Sequence[Any]] = ()
    outflow: Sequence[str] | Mapping[str, Sequence[str]] = ()
    inflow: Mapping[str, float | str] = field(default_factory=dict)
    signs: Sequence[str] = ()
    sizes: Mapping[str, float] = field(default_factory=dict)
    forward: bool = False
    equations: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_list("exchange", self.exchange)
        check_list("signs", self.signs)
        for entry in self.exchange:
            if isinstance(entry, str) or len(entry) not in (2, 3) or entry[0] == entry[1]:
                raise ValueError(
                    "an exchange joins two states, (from, to), by any term or those of a list, "
                    f"(from, to, terms): {entry!r} came"
                )
            check_list("the terms of an exchange", entry[2] if len(entry) == 3 else ())
        for state, size in self.sizes.items():
            if isinstance(size, str | bool) or not 0.0 < size < np.inf:
                raise ValueError(f"sizes must be positive numbers: {state} has {size!r}")
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
        if both := [state for state in self.equations if state in self._with_roles]:
            raise ValueError(f"a state has roles or a known equation: {both} have both")

    @property
    def _with_roles(self) -> set[str]:
        """The states whose equations the roles make."""
        return {s for entry in self.exchange for s in entry[:2]} | {*self.outflow, *self.inflow}

    @property
    def states(self) -> tuple[str, ...]:
        """Every state that is named, once."""
        named = [state for entry in self.exchange for state in entry[:2]]
        signed = [parse_sign(text)[0][0] for text in self.signs]
        more = [*self.outflow, *self.inflow, *signed, *self.sizes, *self.equations]
        return tuple(dict.fromkeys([*named, *more]))

    @property
    def signed(self) -> dict[Place, int]:
        """(state, term) -> 1 or -1, for every demanded sign."""
        return dict(map(parse_sign, self.signs))

    @property
    def known(self) -> dict[Place, float]:
        """The coefficients that are given as numbers: of inflows and known equations."""
        given = {(s, "1"): float(v) for s, v in self.inflow.items() if not isinstance(v, str)}
        for state, terms in self.equations.items():
            given |= {(state, term): float(value) for term, value in terms.items()}
        return given

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
        return replace(self, inflow=own)

    def in_zones(self, sizes: Mapping[str, float]) -> Roles:
        """These roles in adjoining zones of one place, in the order in which the states move on.

        sizes: zone -> its length or volume. States become those of `zone_averages`, `n_i@exit`.
        What states exchange in a zone, they exchange by their product, alone or times one more
        density of the zone or of the giver in a neighbouring zone. Every state with a role moves
        from each zone to the next by terms that it is a factor of, alone or times one other density
        of its zone or its own in the next one. It enters the first zone and leaves the last.
        In the mean all of them go forward. A number as inflow is that of all zones together, as if
        they were one.
        Raises ValueError for demanded signs, or terms, which are of one zone's equations.
        """
        if self.signs or isinstance(self.outflow, Mapping) or any(e[2:] for e in self.exchange):
            raise ValueError(
                "roles in several zones take terms by neighbourhood: give exchanges as (from, to), "
                f"outflow as a list of states, and no signs; {self} came"
            )
        zones, states = list(sizes), self.states
        exchange = [
            (*pair, _exchanged(*pair, near=[f"{giver}@{z}" for z in _beside(zones, k)]))
            for k, zone in enumerate(zones)
            for giver, taker in self.exchange
            for pair in [(f"{giver}@{zone}", f"{taker}@{zone}")]
        ]
        for zone, beyond in pairwise(zones):
            own = [f"{state}@{zone}" for state in states]
            for state in states:
                there = f"{state}@{beyond}"
                terms = _carried(f"{state}@{zone}", [*own, there])
                exchange.append((f"{state}@{zone}", there, terms))
        last = [f"{state}@{zones[-1]}" for state in states]
        share = sum(sizes.values()) / sizes[zones[0]]
        return Roles(
            exchange=exchange,
            outflow={f"{s}@{zones[-1]}": _carried(f"{s}@{zones[-1]}", last) for s in self.outflow},
            inflow={
                f"{state}@{zones[0]}": value if isinstance(value, str) else share * value
                for state, value in self.inflow.items()
            },
            sizes={f"{state}@{zone}": sizes[zone] for zone in zones for state in states},
            forward=True,
        )

    def processes(self, library: Library, states: Sequence[str]) -> list[Process]:
        """Every process that the library and these roles allow, in the equations of the states.

        Raises ValueError for a role of something that is no state, a term that the library lacks,
        or an inflow that is "known" but not yet given.
        """
        self._check(library, states)
        found = []
        every = [name for name in library.names if name != "1"]
        for giver, taker, *some in self.exchange:
            gain = self.sizes.get(giver, 1.0) / self.sizes.get(taker, 1.0)
            for term in _names(library, some[0]) if some else every:
                factors = {(giver, term): -1.0, (taker, term): gain}
                found.append(Process(f"{giver} to {taker}", term, MappingProxyType(factors)))
        named = isinstance(self.outflow, Mapping)
        for state in self.outflow:
            for term in self._leaving(state, library):
                factors = {(state, term): -1.0}
                found.append(
                    Process(f"{state} out", term, MappingProxyType(factors), one_sign=not named)
                )
        for state in [s for s, value in self.inflow.items() if value == FREE]:
            found.append(Process(f"{state} in", "1", MappingProxyType({(state, "1"): 1.0})))
        taken = self._with_roles | {*self.equations}
        for state in [s for s in states if s not in taken]:
            found += [
                Process(f"{state} free", term, MappingProxyType({(state, term): 1.0}))
                for term in library.names
            ]
        return found

    def with_known_terms(self, library: Library, states: Sequence[str]) -> Library:
        """The library with all terms of the known equations; those added stand in no other.

        Raises ValueError for a term of something that is no variable or state.
        """
        named = [term for terms in self.equations.values() for term in terms]
        missing = [term for term in dict.fromkeys(named) if term not in library.names]
        if not missing:
            return library
        variables = tuple(dict.fromkeys([*library.variables, *states]))
        more = [read_term(term, variables) for term in missing]
        return library_of(variables, [*library.terms, *more])

    def _leaving(self, state: str, library: Library) -> list[str]:
        """The terms by which a state may flow out."""
        if isinstance(self.outflow, Mapping):
            return _names(library, self.outflow[state])
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
        if self.inflow:
            library.index("1")
        for _, term in self.signed:
            library.index(term)
        self.with_known_terms(library, states)


def _names(library: Library, terms: Sequence[str]) -> list[str]:
    """Terms as the library writes them. Raises ValueError for one that it lacks."""
    return [library.names[library.index(term)] for term in terms]


def _beside(zones: Sequence[str], k: int) -> list[str]:
    """The neighbours of a zone."""
    return [*zones[max(k - 1, 0) : k], *zones[k + 1 : k + 2]]


def _exchanged(giver: str, taker: str, *, near: Sequence[str]) -> list[str]:
    """Terms by which a state gives another of its zone something; see `Roles.in_zones`."""
    return [_product(giver, taker), *(_product(giver, taker, x) for x in (giver, taker, *near))]


def _carried(state: str, others: Sequence[str]) -> list[str]:
    """Terms by which a state moves on."""
    return [state, *(_product(state, other) for other in others)]


def _product(*names: str) -> str:
    powers = Counter(names)
    return "*".join(name if n == 1 else f"{name}^{n}" for name, n in powers.items())


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
    known: Mapping[Place, float],
) -> Constraint | None:
    """The exact constraint of a model with these processes and known coefficients.

    Returns None if the coefficients do not determine the processes, as with an exchange and the
    outflow of both states by one term.
    """
    places = {place for process in processes for place in process.factors}
    places |= {*known}
    order = sorted(places, key=lambda at: (states.index(at[0]), library.index(at[1])))
    shares = np.array([[p.factors.get(place, 0.0) for p in processes] for place in order])
    fixed = np.array([known.get(place, 0.0) for place in order])
    free = _independent_rows(shares)
    if len(free) < len(processes):
        return None
    C = shares @ np.linalg.inv(shares[free])
    # Most factors are 1, -1 and 0 and so is the result: rounding removes what the inverse adds.
    C = np.where(np.abs(C - np.rint(C)) < 1e-9, np.rint(C), C) + 0.0
    d = fixed - C @ fixed[free]
    return Constraint(tuple(states), tuple(order), C, d, free, tuple(processes))


def shares_of(held: Constraint) -> Float[np.ndarray, "free processes"]:
    """What the constraint's processes, with coefficients of one, make of its free coefficients."""
    places = [held.coefficients[k] for k in held.free]
    return np.array([[p.factors.get(at, 0.0) for p in held.processes] for at in places])


def _independent_rows(matrix: Float[np.ndarray, "rows columns"]) -> np.ndarray:
    """Indices of the first rows that are linearly independent of those before them."""
    found: list[int] = []
    for k in range(len(matrix)):
        if np.linalg.matrix_rank(matrix[[*found, k]]) > len(found):
            found.append(k)
    return np.array(found, dtype=np.int64)
