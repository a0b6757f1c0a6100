"""Roles of terms in equations of balance: what one state gives another, loses, or is supplied with.

A process is a term with its role. It may stand in several equations, with fixed factors, so that a
search takes it into all of them or into none, and what it moves is conserved. Equations by process
show what enters, is exchanged and leaves, with common factors taken out.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import compress, pairwise
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ep2sindy.library.names import factors_of, product_of
from ep2sindy.library.relations import Constraint, Place, Process
from ep2sindy.library.terms import NamedTerms, read_term
from ep2sindy.runtime.values import check_list

KNOWN, FREE, EITHER = "known", "free", "known or free"
BY_POINT = "by the point"  # of an inflow that is a sum of functions of the operating point

Equations = Mapping[str, Mapping[str, float]]  # state -> term -> number
Processes = Sequence[Process]


class Role(NamedTuple):
    """What moves from one state to another; "" is the outside.

    how: "free" if any admissible term may move it, the terms that may, the terms with their known
    coefficients in SI, or "known" and "known or free" while a record has not given them.
    """

    giver: str
    taker: str
    how: Any

    @property
    def name(self) -> str:
        """Such as `n_n to n_i`, `n_i out`, `n_n in`."""
        if self.giver and self.taker:
            return f"{self.giver} to {self.taker}"
        return f"{self.giver} out" if self.giver else f"{self.taker} in"


@dataclass(frozen=True)
class Roles:
    """Roles of terms, for a search whose equations conserve what the states exchange.

    A role states what a term may do: it moves something from one state to another (exchange),
    removes it (outflow) or supplies it (inflow). A state without a role has an equation of free
    terms.

    Any term of the library may be exchanged, with a coefficient of either sign, and powers of a
    state may leave, with coefficients that take away. With `nonnegative`, states are numbers of
    bodies or densities, and terms obey mass action: what lowers a state contains it as a factor.
    Terms that contain the first state of an exchange then move forward; terms that contain the
    second state, but not the first, move back, unless that direction is an exchange of its own.
    Terms named for a role must contain its first state, too. Terms of a reaction contain every
    reacting body as often as it reacts. All coefficients are positive, so that no state can become
    negative.

    Parameters
    ----------
    exchange : sequence of (from, to) or (from, to, how)
        A term in this role leaves the first equation and enters the second with the same
        coefficient. If several bodies take part, a side names them all, as a reaction does:
        ("E + S", "ES") or ("A + X", "X + X").
    outflow : sequence of str or mapping of str to how
        States that lose something to the outside.
    inflow : mapping of str to how
        What each state is supplied with: a number in SI per second, "free", "known",
        "known or free", or a list of terms, such as births by the state itself. Of several
        operating points also a sum of functions of the point, as {"mdot_mg_s": 4.58e22}.
    nonnegative : bool, default False
        True if states cannot be negative and terms obey mass action.
    sizes : mapping of str to float, default {}
        Length or volume over which each state is an average, since what leaves a small volume
        changes a large one by less. Absent sizes are one.
    equations : mapping of str to mapping of str to float, default {}
        Terms with their coefficients in SI of each state whose equation is known. The library need
        not hold these terms.
    forward : bool, default False
        True if every role must move more forward than back in the mean over the records, as between
        zones.

    Raises
    ------
    ValueError
        If both sides of an exchange are the same, a size is not positive, a role is given twice, or
        a state has both a role and a known equation.

    Notes
    -----
    An exchange of term f from a to b with coefficient c adds

        a' = ... - c f,   b' = ... + c f size_a / size_b

    The `how` of a role is "free" (any term, the default), a list of the terms that may play it, a
    mapping from term to its known coefficient in SI, or "known" and "known or free", which an
    experiment replaces by what the record itself gives.

    Examples
    --------
    >>> roles = ep.Roles(exchange=[("prey", "predator")], outflow=["predator"], nonnegative=True)
    >>> library = ep.polynomial(["prey", "predator"], degree=2)
    >>> [f"{p.role}: {p.term}" for p in roles.processes(library, ["prey", "predator"])][:3]
    ['prey to predator: prey', 'prey to predator: prey^2', 'prey to predator: prey*predator']
    """

    exchange: Sequence[Sequence[Any]] = ()
    outflow: Sequence[str] | Mapping[str, Any] = ()
    inflow: Mapping[str, Any] = field(default_factory=dict)
    nonnegative: bool = False
    sizes: Mapping[str, float] = field(default_factory=dict)
    equations: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    forward: bool = False

    def __post_init__(self) -> None:
        check_list("exchange", self.exchange)
        for entry in self.exchange:
            if (
                isinstance(entry, str)
                or len(entry) not in (2, 3)
                or _bodies(entry[0]) == _bodies(entry[1])
            ):
                raise ValueError(
                    "an exchange joins two states, (from, to), or sides such as 'A + B', by any "
                    f"term, or by those that a third entry names, got {entry!r}"
                )
        if not isinstance(self.outflow, Mapping):
            check_list("outflow", self.outflow)
        for state, size in self.sizes.items():
            if isinstance(size, str | bool) or not 0.0 < size < np.inf:
                raise ValueError(f"sizes must be positive numbers: {state} has {size!r}")
        named = Counter(role.name for role in self._roles)
        if twice := [name for name, n in named.items() if n > 1]:
            raise ValueError(f"a role must be given once, got {twice} twice")
        for role in self._roles:
            _check_how(role)
            supply = role.how.get("1", 0.0) if isinstance(role.how, Mapping) else 0.0
            if self.nonnegative and not role.giver and supply < 0.0:
                raise ValueError(
                    f"of states that cannot be negative an inflow is zero or more, got {supply:g} "
                    f"for {role.taker!r}; what a state loses is its outflow"
                )
        if both := [state for state in self.equations if state in self.balanced]:
            raise ValueError(f"a state has roles or a known equation: {both} have both")

    @property
    def _roles(self) -> list[Role]:
        """Every role that is given, with how it is played."""
        found = [Role(*entry[:2], *(entry[2:] or [FREE])) for entry in self.exchange]
        leaving = self.outflow
        ways = leaving if isinstance(leaving, Mapping) else dict.fromkeys(leaving, FREE)
        found += [Role(state, "", how) for state, how in ways.items()]
        for state, how in self.inflow.items():
            if isinstance(how, Mapping):
                how = BY_POINT
            elif not isinstance(how, str | bool | Sequence):
                how = {"1": float(how)}
            found.append(Role("", state, how))
        return found

    @property
    def by_point(self) -> dict[str, Mapping[str, float]]:
        """Inflows by functions of the operating point: state -> function -> factor."""
        return {state: how for state, how in self.inflow.items() if isinstance(how, Mapping)}

    @property
    def names(self) -> set[str]:
        """The roles that must be played: all that are given."""
        return {role.name for role in self._roles}

    @property
    def open(self) -> list[str]:
        """The roles that a record may have to tell, such as `n_n in`."""
        return [role.name for role in self._roles if role.how in (KNOWN, EITHER)]

    @property
    def balanced(self) -> set[str]:
        """The states whose equations the roles make."""
        return {state for role in self._roles for side in role[:2] for state in _bodies(side)}

    @property
    def positive(self) -> list[str]:
        """The states that cannot turn negative."""
        return sorted(self.balanced) if self.nonnegative else []

    @property
    def states(self) -> tuple[str, ...]:
        """Every state that is named, once."""
        named = [state for role in self._roles for side in role[:2] for state in _bodies(side)]
        return tuple(dict.fromkeys([*named, *self.sizes, *self.equations]))

    @property
    def known_processes(self) -> list[Process]:
        """The processes whose coefficients are known: of known roles, and of known equations."""
        found = [
            replace(self._process(role, term), value=float(value))
            for role in self._roles
            if isinstance(role.how, Mapping)
            for term, value in role.how.items()
        ]
        for state, terms in self.equations.items():
            for term, value in terms.items():
                one = MappingProxyType({(state, term): 1.0})
                found.append(Process(f"{state} known", term, one, value=float(value)))
        return found

    @property
    def known(self) -> dict[Place, float]:
        """What known processes add to the coefficients, in SI."""
        return sum_known(self.known_processes)

    def with_known(self, known: Mapping[str, Mapping[str, float]]) -> Roles:
        """These roles with what a record gives in place of "known".

        known: role, such as `n_n in` or `n_i to n_n`, -> term -> coefficient in SI.
        Raises ValueError for a role that the record does not give.
        """
        for role in self._roles:
            if isinstance(role.how, str) and role.how == KNOWN and role.name not in known:
                raise ValueError(
                    f"{role.name!r} is not known for this record, which gives {dict(known)}: what "
                    f"enters follows from the mass flow, for the neutrals of a zone that begins at "
                    f"the anode of a simulated thruster, and the rest from its balance; give "
                    f"numbers, or {FREE!r}"
                )

        roles = [
            role._replace(how=dict(known.get(role.name, {})) or FREE)
            if role.name in self.open
            else role
            for role in self._roles
        ]
        return replace(
            self,
            exchange=[tuple(role) for role in roles if role.giver and role.taker],
            outflow={role.giver: role.how for role in roles if not role.taker},
            inflow={
                role.taker: role.how["1"] if isinstance(role.how, Mapping) else role.how
                for role in roles
                if not role.giver
            }
            | self.by_point,
        )

    def in_zones(self, sizes: Mapping[str, float]) -> Roles:
        """These roles in adjoining zones, in the order in which the states move on.

        What states exchange in a zone, they exchange by their product, by itself or times one more
        density of the zone or of the giver in a neighbouring zone. Every state with a role moves
        from each zone to the next by terms that it is a factor of, by itself or times one other
        density of its zone or its own in the next one. It enters the first zone and leaves the
        last. In the mean all of them go forward. A number as inflow is that of all zones together,
        as if they were one.

        Parameters
        ----------
        sizes : mapping of str to float
            Length or volume of each zone. States become those of `zone_averages`, such as
            `n_i@exit`.

        Returns
        -------
        Roles
            The roles of all zones.

        Raises
        ------
        ValueError
            If the roles name terms, which belong to one zone's equations.
        """
        named = [role.giver or not isinstance(role.how, str | Mapping) for role in self._roles]
        several = any("+" in role.name for role in self._roles)
        if several or any(role.how != FREE for role in compress(self._roles, named)):
            raise ValueError(
                "roles in several zones take terms by neighbourhood: give exchanges as (from, to), "
                f"and outflow as a list of states, got {self}"
            )
        zones, states = list(sizes), self.states
        exchange = [
            (*pair, _list_exchanges(*pair, near=[f"{giver}@{z}" for z in neighbours]))
            for k, zone in enumerate(zones)
            for giver, taker, _ in [role for role in self._roles if role.giver and role.taker]
            for pair in [(f"{giver}@{zone}", f"{taker}@{zone}")]
            for neighbours in [(*zones[max(k - 1, 0) : k], *zones[k + 1 : k + 2])]
        ]
        for zone, beyond in pairwise(zones):
            own = [f"{state}@{zone}" for state in states]
            for state in states:
                there = f"{state}@{beyond}"
                terms = _carriers(f"{state}@{zone}", [*own, there])
                exchange.append((f"{state}@{zone}", there, terms))
        last = [f"{state}@{zones[-1]}" for state in states]
        ratio = sum(sizes.values()) / sizes[zones[0]]
        return Roles(
            exchange=exchange,
            outflow={f"{s}@{zones[-1]}": _carriers(f"{s}@{zones[-1]}", last) for s in self.outflow},
            inflow={
                f"{state}@{zones[0]}": value if isinstance(value, str) else ratio * value
                for state, value in self.inflow.items()
            },
            sizes={f"{state}@{zone}": sizes[zone] for zone in zones for state in states},
            nonnegative=self.nonnegative,
            forward=True,
        )

    def processes(self, library: NamedTerms, states: Sequence[str]) -> list[Process]:
        """Every process that is to be found, of those that the library and these roles allow.

        Raises ValueError for a role of something that is no state, a term that the library lacks,
        a role that no term of the library may play, or one that is "known" but not yet given.
        """
        self._check(library, states)
        found = []
        for role in self._roles:
            if isinstance(role.how, Mapping):
                continue
            played = list(self._played(role, library))
            if not played:
                raise ValueError(
                    f"no term of the library may play the role {role.name!r}, as it must contain "
                    f"{role.giver!r}: it has {list(library.names)}; raise its degree, or leave the "
                    "role out"
                )
            found += played
        taken = self.balanced | {*self.equations}
        for state in [s for s in states if s not in taken]:
            found += [
                Process(f"{state} free", term, MappingProxyType({(state, term): 1.0}))
                for term in library.names
            ]
        return found

    def _played(self, role: Role, library: NamedTerms) -> Iterator[Process]:
        """The processes by which a role may be played."""
        giver, taker, how = role
        free = [name for name in library.names if name != "1"] if giver else ["1"]
        terms = free if how == FREE else [library.names[library.index(term)] for term in how]
        if how == FREE and not taker:
            terms = [term for term in terms if set(factors_of(term)) == set(_bodies(giver))]
        if not (giver and self.nonnegative):
            yield from (self._process(role, term) for term in terms)
            return
        if how != FREE and (wrong := [term for term in terms if not _holds(term, giver)]):
            raise ValueError(
                f"by mass action what lowers {giver!r} contains it, got {wrong} for the role "
                f"{role.name!r}; name other terms, or leave nonnegative out"
            )
        yield from (self._process(role, term) for term in terms if _holds(term, giver))
        back = Role(taker, giver, how)
        if how == FREE and taker and back.name not in self.names:
            for term in terms:
                if _holds(term, taker) and not _holds(term, giver):
                    yield self._process(back, term)

    def _process(self, role: Role, term: str) -> Process:
        """A term in a role; without `nonnegative` only the powers that flow out have a sign."""
        factors: dict[Place, float] = {}
        moved = [(state, -n) for state, n in _bodies(role.giver).items()]
        moved += _bodies(role.taker).items()
        first = self.sizes.get(moved[0][0], 1.0)
        for state, n in moved:
            factor = n * first / self.sizes.get(state, 1.0)
            factors[state, term] = factors.get((state, term), 0.0) + factor
        factors = {place: factor for place, factor in factors.items() if factor}
        signed = self.nonnegative or (not role.taker and role.how == FREE)
        return Process(role.name, term, MappingProxyType(factors), one_sign=signed)

    def _check(self, library: NamedTerms, states: Sequence[str]) -> None:
        if unknown := [state for state in self.states if state not in states]:
            raise ValueError(
                f"roles must name states, got {unknown}, and the states are {list(states)}"
            )
        if self.open:
            raise ValueError(
                f"{self.open} are known only where a record gives them, as in the experiments on a "
                f"simulated thruster: give numbers in SI, or {FREE!r}"
            )
        if self.by_point:
            raise ValueError(
                f"an inflow by the operating point needs runs that have one, got {self.by_point}: "
                "give Trajectory(..., parameters={...}), or a number in SI per second"
            )
        if self.inflow:
            library.index("1")
        variables = tuple(dict.fromkeys([*library.variables, *states]))
        for _, term in self.known:
            if (name := read_term(term, variables).name) != term:
                raise ValueError(
                    f"a known term must be written as the library does, {name!r}, got {term!r}"
                )


def _check_how(role: Role) -> None:
    """Raises ValueError for a role that is not played in one of the ways that `Roles` names."""
    how, words = role.how, (KNOWN, FREE, EITHER, *([] if role.giver else [BY_POINT]))
    if isinstance(how, str):
        is_one = how in words
    elif isinstance(how, Mapping):
        is_number = [not isinstance(v, str | bool) and np.isfinite(v) for v in how.values()]
        is_one = bool(how) and all(is_number)
    else:
        is_one = isinstance(how, Sequence)
    if is_one:
        return
    ways = "terms with their coefficients in SI" if role.giver else "a number in SI per second"
    raise ValueError(
        f"how {role.name!r} is played must be {ways}, a list of terms, {KNOWN!r}, {FREE!r} or "
        f"{EITHER!r}, got {how!r}"
    )


def _bodies(side: str) -> Counter[str]:
    """The states on a side, such as A + B, and how often each stands there; none outside."""
    return Counter(state.strip() for state in side.split("+") if side)


def _holds(term: str, side: str) -> bool:
    """Whether all bodies of a side are factors of a term."""
    return _bodies(side) <= Counter(factors_of(term))


def _list_exchanges(giver: str, taker: str, *, near: Sequence[str]) -> list[str]:
    """Terms by which a state gives another of its zone something; see `Roles.in_zones`."""
    pair = [giver, taker]
    return [product_of(Counter(pair)), *(product_of(Counter([*pair, x])) for x in [*pair, *near])]


def _carriers(state: str, others: Sequence[str]) -> list[str]:
    """Terms by which a state moves on."""
    return [state, *(product_of(Counter([state, other])) for other in others)]


def sum_known(processes: Processes) -> dict[Place, float]:
    """What processes with known coefficients add to the coefficients of a model, in SI."""
    found: dict[Place, float] = {}
    for process in processes:
        for place, factor in process.factors.items():
            found[place] = found.get(place, 0.0) + factor * (process.value or 0.0)
    return found


def constraint_of(
    library: NamedTerms, states: Sequence[str], processes: Processes, known: Processes = ()
) -> Constraint | None:
    """The exact constraint of a model with these processes, and those with known coefficients.

    Returns None if the coefficients do not determine the processes, as with an exchange and the
    outflow of both states by one term.
    """
    amounts = sum_known(known)
    places = {place for process in processes for place in process.factors}
    places |= {*amounts}
    order = sorted(places, key=lambda at: (states.index(at[0]), library.index(at[1])))
    factors = np.array([[p.factors.get(place, 0.0) for p in processes] for place in order])
    fixed = np.array([amounts.get(place, 0.0) for place in order])
    free = _independent_rows(factors)
    if len(free) < len(processes):
        return None
    C = factors @ np.linalg.inv(factors[free])
    # Most factors are 1, -1 and 0 and so is the result: rounding removes what the inverse adds.
    C = np.where(np.abs(C - np.rint(C)) < 1e-9, np.rint(C), C) + 0.0
    d = fixed - C @ fixed[free]
    return Constraint(tuple(states), tuple(order), C, d, free, tuple(processes), tuple(known))


def process_matrix(held: Constraint) -> Float[np.ndarray, "free processes"]:
    """What the constraint's processes, with coefficients of one, make of its free coefficients."""
    places = [held.coefficients[k] for k in held.free]
    return np.array([[p.factors.get(at, 0.0) for p in held.processes] for at in places])


def process_amounts(held: Constraint, terms: Equations) -> list[tuple[Process, float]]:
    """Every process with its coefficient, those to be found first; terms of a model by state."""
    known = sum_known(held.known)
    places = [held.coefficients[k] for k in held.free]
    found = [terms[s].get(term, 0.0) - known.get((s, term), 0.0) for s, term in places]
    values = np.linalg.solve(process_matrix(held), found).tolist()
    given = [(process, process.value or 0.0) for process in held.known]
    return [*zip(held.processes, values, strict=True), *given]


def _independent_rows(matrix: Float[np.ndarray, "rows columns"]) -> np.ndarray:
    """Indices of the first rows that are linearly independent of those before them."""
    found: list[int] = []
    for k in range(len(matrix)):
        if np.linalg.matrix_rank(matrix[[*found, k]]) > len(found):
            found.append(k)
    return np.array(found, dtype=np.int64)


# Equations by process.


IN, OUT = " in", " out"  # what enters is written first, and what leaves last
ROLELESS = (" free", " known")  # terms of states without roles, which move nothing
SEPARATE = (IN, *ROLELESS)  # roles whose terms are written one by one


@dataclass(frozen=True)
class Group:
    """A part of an equation, sign * factor * (sum of terms).

    sign: 1 or -1. factor: what all terms have in common, such as `n_i*n_n`; "1" if nothing, or for
    a single term. terms: what is left of each -> its coefficient. reach: half-width of the interval
    of each coefficient, as far as it is known.
    """

    sign: int
    factor: str
    terms: Mapping[str, float]
    reach: Mapping[str, float] = field(default_factory=dict)


Part = tuple[str, float, float, float]  # a process in an equation: term, factor, amount, half-width


def groups_of(
    held: Constraint, coef: Equations, reach: Equations | None = None, *, per: float = 1.0
) -> dict[str, list[Group]]:
    """The equations of a model under roles: state -> its groups, what enters first.

    held: from a search under `Roles`. coef: coefficients of the model in SI. reach: half-widths of
    their intervals. per: time unit of the numbers, in s. What states exchange has the same terms
    and digits in both of their equations. A process has an interval if one of the equations tells
    it apart from others by the same term.
    """
    amounts = process_amounts(held, coef)
    widths = [*_process_widths(held, reach or {}), *(0.0 for _ in held.known)]
    found: dict[str, list[Group]] = {}
    for state in held.states:
        parts: dict[str, list[Part]] = {}  # by role
        for (process, value), reached in zip(amounts, widths, strict=True):
            role = process.role
            key = f"{role} {process.term}" if role.endswith(SEPARATE) else role
            for (there, term), factor in process.factors.items():
                if there == state:
                    amount, width = (per * abs(factor) * each for each in (value, reached))
                    parts.setdefault(key, []).append((term, factor, amount, width))
        order = sorted(parts, key=lambda key: (key.endswith(OUT)) - (IN in key))
        found[state] = [_group(parts[key]) for key in order]
    return found


def _process_widths(held: Constraint, reach: Equations) -> list[float]:
    """Half-width of the interval of every process; zero if no equation gives it alone.

    Where two processes have one term in an equation, its interval is that of their sum.
    """
    fitted = Counter(place for process in held.processes for place in process.factors)
    return [
        next(
            (
                reach.get(state, {}).get(term, 0.0) / abs(factor)
                for (state, term), factor in process.factors.items()
                if fitted[state, term] == 1
            ),
            0.0,
        )
        for process in held.processes
    ]


def _group(parts: Sequence[Part]) -> Group:
    """One process in one equation, with a sign such that not all of its terms are negative."""
    sign = 1 if parts[0][1] > 0.0 else -1
    terms = {term: amount for term, _, amount, _ in parts}
    if all(value < 0.0 for value in terms.values()):
        sign, terms = -sign, {term: -value for term, value in terms.items()}
    powers = {term: factors_of(term) for term in terms}
    first, *others = powers.values()
    common = {name: min([n, *(p.get(name, 0) for p in others)]) for name, n in first.items()}
    if not others or not any(common.values()):
        common = {}
    left = {
        term: product_of({name: n - common.get(name, 0) for name, n in own.items()})
        if common else term
        for term, own in powers.items()
    }  # fmt: skip
    return Group(
        sign,
        product_of(common),
        {left[term]: value for term, value in terms.items()},
        {left[term]: width for term, _, _, width in parts if width > 0.0},
    )
