"""What is known of equations before they are searched, and the checks of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from ep2sindy.library.names import factors_of
from ep2sindy.library.relations import Place, Relation
from ep2sindy.library.roles import Roles
from ep2sindy.library.terms import NamedTerms
from ep2sindy.runtime.values import check_kind, check_list

# State -> term -> function of the parameters -> its factor.
Known = Mapping[str, Mapping[str, Mapping[str, float]]]


@dataclass(frozen=True, eq=False)
class Facts:
    """What is known of the equations of a library; the methods of `Library` say it.

    relations: between coefficients. only: for each state whose equation is known but for its
    coefficients, all terms of that equation. excluded: for each state that is named, terms that its
    equation may not have. known: coefficients that are functions of the operating point, in SI.
    roles: of terms, for equations that conserve what states exchange.
    Raises ValueError for what are no lists of names or no sums of functions, an equation without
    terms, or roles next to anything else.
    """

    relations: Sequence[Relation] = ()
    only: Mapping[str, Sequence[str]] = field(default_factory=dict)
    excluded: Mapping[str, Sequence[str]] = field(default_factory=dict)
    known: Known = field(default_factory=dict)
    roles: Roles | None = None

    def __post_init__(self) -> None:
        for name in ("only", "excluded"):
            object.__setattr__(self, name, _by_state(getattr(self, name)))
        if empty := [state for state, terms in self.only.items() if not terms]:
            raise ValueError(f"an equation whose terms are given must have some: {empty} has none")
        object.__setattr__(self, "known", _copy(self.known))
        if self.roles is None:
            return
        check_kind("roles", self.roles, Roles, "ep.Roles(exchange=[('n_n', 'n_i')])")
        if self.relations or self.only or self.excluded or self.known:
            raise ValueError(
                "roles say which terms the equations may have and how they are tied, got "
                "relations, terms, or coefficients as well; give roles alone, or leave them out"
            )

    def __or__(self, more: Facts) -> Facts:
        """These facts and more of them; one that is given twice counts once.

        Raises ValueError for terms of one equation, a known coefficient or roles that are given
        twice and differ.
        """
        barred = {**self.excluded, **more.excluded}
        only = {
            s: _same(f"the terms of {s!r}", self.only.get(s), more.only.get(s), kind=frozenset)
            for s in {**self.only, **more.only}
        }
        own, others = self.known_factors, more.known_factors
        known: dict[str, dict[str, Mapping[str, float]]] = {}
        for state, term in {**own, **others}:
            values = own.get((state, term)), others.get((state, term))
            known.setdefault(state, {})[term] = _same(f"the coefficient {state}: {term}", *values)
        return Facts(
            tuple(dict.fromkeys((*self.relations, *more.relations))),
            only,
            {s: (*self.excluded.get(s, ()), *more.excluded.get(s, ())) for s in barred},
            known,
            _same("roles", self.roles, more.roles),
        )

    @property
    def known_factors(self) -> dict[Place, Mapping[str, float]]:
        """(state, term) -> function of the parameters -> its factor, of known coefficients."""
        return {(s, term): own for s, terms in self.known.items() for term, own in terms.items()}

    @property
    def places(self) -> list[Place]:
        """Every (state, term) that an equation must have."""
        named = [(state, term) for r in self.relations for _, state, term in r.factors]
        named += [(state, term) for state, terms in self.only.items() for term in terms]
        return [*named, *self.known_factors]

    @property
    def made(self) -> set[str]:
        """The variables that known equations of others define, as v is by x' = v.

        An equation is known if its terms are given and each has a number as coefficient.
        """
        numbers = {r.factors[0][1:] for r in self.relations if len(r.factors) == 1}
        known = {s: terms for s, terms in self.only.items()
                 if all((s, term) in numbers for term in terms)}  # fmt: skip
        return {v for s, terms in known.items() for t in terms for v in factors_of(t) if v != s}

    def check(self, library: NamedTerms) -> None:
        """Raise ValueError for an unknown term, one that is excluded and named, or none left."""
        barred = {s: {*map(library.index, terms)} for s, terms in self.excluded.items()}
        for state, places in barred.items():
            if len(places) == len(library.names):
                raise ValueError(
                    f"exclude must leave terms to every equation, got all {len(places)} of the "
                    f"library for {state!r}; leave some of them out of exclude"
                )
        for state, term in self.places:
            if library.index(term) in barred.get(state, ()):
                raise ValueError(
                    f"a term is excluded, or it is named in terms and relations, got {term!r} of "
                    f"{state!r} in both; leave it out of one of them"
                )

    @property
    def lines(self) -> list[str]:
        """A sentence on everything that is known."""
        return [
            *(relation.text for relation in self.relations),
            *(f"{state}' has {', '.join(terms)}" for state, terms in self.only.items()),
            *(f"{state}' has no {', '.join(terms)}" for state, terms in self.excluded.items()),
            *(f"{state}: {term} by the point" for state, term in self.known_factors),
            *([repr(self.roles)] if self.roles else []),
        ]


def _by_state(given: object) -> Mapping[str, tuple[str, ...]]:
    """The terms of every state that are named. Raises ValueError for what are no lists of names."""
    example = "{'x': ['x', 'x*y']}"
    if not isinstance(given, Mapping):
        raise ValueError(f"terms must be lists by state, like {example}, got {given!r}")
    for state, names in given.items():
        check_list(f"the terms of {state!r}", names)
        if not isinstance(names, Sequence) or not all(isinstance(name, str) for name in names):
            raise ValueError(
                f"terms must be lists of names, like {example}, got {names!r} for {state!r}; the "
                "constant is '1', and a coefficient that is known is a relation, 'x: x == 0.5'"
            )
    return MappingProxyType({state: tuple(dict.fromkeys(n)) for state, n in given.items()})


def _copy(given: Any) -> Known:
    """Known coefficients. Raises ValueError for what are no sums of functions by state and term."""
    states = given.values() if isinstance(given, Mapping) else [given]
    if not all(
        isinstance(terms, Mapping) and all(isinstance(f, Mapping) for f in terms.values())
        for terms in states
    ):
        raise ValueError(
            "a known coefficient is a sum of functions of the parameters, such as "
            f"{{'x': {{'x*y': {{'1': 2.0}}}}}}, got {given!r}"
        )
    return {s: {str(term): dict(f) for term, f in terms.items()} for s, terms in given.items()}


def _same(what: str, first: Any, second: Any, kind: Callable[[Any], Any] = lambda one: one) -> Any:
    """What is given by one of two, or alike by both; kind: frozenset if the order is none."""
    if first is None or second is None:
        return second if first is None else first
    if kind(first) != kind(second):
        raise ValueError(f"{what} must be given once, got {first} and {second}; drop one of them")
    return first
