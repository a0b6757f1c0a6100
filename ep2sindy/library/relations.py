"""Linear relations between coefficients, eliminated once as coef = C z + d with free values z.

If a support lacks some of the coefficients, `binding` and `complete` determine what the relations
require of it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int

from ep2sindy.library.names import NUMBER, PRODUCT, VARIABLE
from ep2sindy.library.terms import NamedTerms
from ep2sindy.runtime.values import check_list, read_only

ROUNDING = 1e-12  # a sum this small relative to its addends has cancelled and counts as zero

_NUMBER = rf"{NUMBER}(?!\w)"

_TERM = rf"(?:1(?![\w.]|\s*/)|{PRODUCT})"

_ADDEND = re.compile(
    rf"\s*+(?P<sign>[+-]?)\s*+(?:(?:(?P<factor>[+-]?{_NUMBER})\s*+\*\s*+)?"
    rf"(?P<state>{VARIABLE})\s*+:\s*+(?P<term>{_TERM})|(?P<number>[+-]?{_NUMBER}))\s*+"
)

Place = tuple[str, str]  # (state, term)
Support = Mapping[str, Sequence[str]]  # state -> terms of its equation

_EXAMPLE = "write it like 'n_i: n_i*n_n == -1 * n_n: n_i*n_n'"


@dataclass(frozen=True)
class Relation:
    """One linear relation: the sum of factor * coef(state, term) over `factors` is `value`.

    factors: (factor, state, term) as named in `text`. Numbers refer to coefficients in SI.
    """

    factors: tuple[tuple[float, str, str], ...]
    value: float
    text: str = field(compare=False)

    def __post_init__(self) -> None:
        if not self.factors:
            raise ValueError(f"a relation must name a coefficient, got {self.text!r}; {_EXAMPLE}")
        if not np.isfinite([self.value, *(factor for factor, _, _ in self.factors)]).all():
            raise ValueError(f"the numbers of a relation must be finite, got {self.text!r}")


def parse_relation(text: str) -> Relation:
    """Read a relation: `2 * x: x*y + y: x*y == 0`, or `n_n: 1 == 1.83e23` for a known value.

    Each side adds and subtracts numbers and coefficients, `[number *] state: term`.
    Raises ValueError with the text and the position of the first part that cannot be read.
    """
    if text.count("==") != 1:
        raise ValueError(f"a relation has two sides joined by one '==', got {text!r}; {_EXAMPLE}")
    middle = text.index("==")
    factors: list[tuple[float, str, str]] = []
    value = 0.0
    for start, stop, side in ((0, middle, 1.0), (middle + 2, len(text), -1.0)):
        for addend in _addends(text, start, stop):
            sign = -side if addend["sign"] == "-" else side
            if addend["number"]:
                value -= sign * float(addend["number"])
            else:
                factor = sign * float(addend["factor"] or 1.0)
                factors.append((factor, addend["state"], addend["term"]))
    return Relation(tuple(factors), value, text.strip())


def _addends(text: str, start: int, stop: int) -> Iterator[re.Match[str]]:
    """Addends on one side of a relation, as matches of `_ADDEND`."""
    position = start
    while position == start or position < stop:
        if position > start and text[position] not in "+-":
            raise _unreadable(text, position, "+, -, == or the end")
        addend = _ADDEND.match(text, position, stop)
        if addend is None:
            raise _unreadable(text, position, "'[number *] state: term' or a number")
        yield addend
        position = addend.end()


def _unreadable(text: str, position: int, expected: str) -> ValueError:
    rest = text[position:].lstrip()
    return ValueError(
        f"{expected} must stand at character {len(text) - len(rest) + 1} of the relation "
        f"{text!r}, got {rest[:12] or 'the end'!r}; {_EXAMPLE}"
    )


@dataclass(frozen=True)
class Process:
    """One term in one role: its coefficient enters the equations with these factors.

    factors: (state, term) -> what a coefficient of one adds to the equation. one_sign: True if its
    coefficient must be positive. value: of its coefficient in SI, if it is known.
    """

    role: str
    term: str
    factors: Mapping[Place, float]
    one_sign: bool = False
    value: float | None = None


@dataclass(frozen=True, eq=False)
class Constraint:
    """Parametrisation of all coefficients that obey the relations: coef = C z + d, in SI.

    coefficients: (state, term) of each, equation by equation, in the order of the library.
    free: (free,), indices of the coefficients that z holds: C[free] is the identity, d[free] zero.
    states: one per equation, including equations without terms. processes: those that the free
    coefficients determine, as many, if it comes from a search under `Roles`; else empty. known:
    processes whose coefficients are known.
    """

    states: tuple[str, ...]
    coefficients: tuple[tuple[str, str], ...]
    C: Float[np.ndarray, "coefs free"]
    d: Float[np.ndarray, " coefs"]
    free: Int[np.ndarray, " free"]
    processes: Sequence[Process] = ()
    known: Sequence[Process] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "C", read_only(self.C))
        object.__setattr__(self, "d", read_only(self.d))
        assert len(self.coefficients) == len(self.d)
        assert np.array_equal(self.C[self.free], np.eye(len(self.free)))
        assert not self.d[self.free].any()

    @property
    def support(self) -> dict[str, list[str]]:
        """The terms of the equation of each state."""
        return {s: [t for state, t in self.coefficients if state == s] for s in self.states}

    def coef(self, z: Float[np.ndarray, " free"]) -> Float[np.ndarray, " coefs"]:
        """Values of all coefficients from the values z of the free ones."""
        return self.C @ z + self.d

    def equations(self, z: Float[np.ndarray, " free"]) -> dict[str, dict[str, float]]:
        """The same by state and term."""
        found: dict[str, dict[str, float]] = {state: {} for state in self.states}
        for (state, term), value in zip(self.coefficients, self.coef(z).tolist(), strict=True):
            found[state][term] = value
        return found


def constraint(
    library: NamedTerms, support: Support, relations: Sequence[Relation | str] = ()
) -> Constraint:
    """Eliminate one coefficient of the support per relation that does not follow from others.

    The coefficient with the largest factor is eliminated; among equal factors, the one whose first
    mention in the relations comes last.

    Parameters
    ----------
    library : NamedTerms
        The terms.
    support : mapping of str to sequence of str
        Terms of the equation of each state.
    relations : sequence of Relation or str, default ()
        Linear relations between coefficients, such as `"x: x*y == -1 * y: x*y"` or `"x: y == 1"`,
        in SI.

    Returns
    -------
    Constraint
        Matrix C and vector d of coef = C z + d, where z holds the free coefficients.

    Raises
    ------
    ValueError
        If a relation contradicts earlier ones, names an unknown state or term, or names
        a term outside the support. The error quotes the relation.

    Examples
    --------
    >>> library = ep.polynomial(["x", "y"], degree=2)
    >>> support = {"x": ["x", "x*y"], "y": ["y", "x*y"]}
    >>> ep.library.constraint(library, support, ["x: x*y == -1 * y: x*y"]).C.shape
    (4, 3)
    """
    for state, terms in support.items():
        check_list(f"the support of {state!r}", terms)
    coefficients = tuple(
        (state, library.names[j])
        for state, terms in support.items()
        for j in sorted({library.index(term) for term in terms})
    )
    C, d = np.eye(len(coefficients)), np.zeros(len(coefficients))
    free = np.ones(len(coefficients), dtype=np.bool_)
    named: dict[int, None] = {}
    earlier: list[str] = []
    for relation in relations_of(relations):
        row, size = np.zeros((2, len(coefficients)))
        for factor, state, term in relation.factors:
            k = place_of(library, coefficients, state, term, f"relation {relation.text!r}")
            named[k] = None
            row[k] += factor
            size[k] += abs(factor)
        factors = _round(row @ C, size @ np.abs(C))
        value = _round(relation.value - row @ d, abs(relation.value) + size @ np.abs(d))
        if not factors.any():  # it holds already, or cannot
            if not value:
                continue
            others = f"the earlier ones, {earlier}" if earlier else "arithmetic alone"
            raise ValueError(f"relation {relation.text!r} contradicts {others}; drop one of them")
        largest = (1.0 - ROUNDING) * np.abs(factors).max()
        last = [k for k in named if abs(factors[k]) >= largest][-1]
        change = np.outer(C[:, last], -factors / factors[last])
        shift = C[:, last] * (value / factors[last])
        C = _round(C + change, np.abs(C) + np.abs(change))
        d = _round(d + shift, np.abs(d) + np.abs(shift))
        C[:, last], free[last] = 0.0, False
        earlier.append(relation.text)
    return Constraint(tuple(support), coefficients, C[:, free], d, np.flatnonzero(free))


def place_of(
    library: NamedTerms, coefficients: Sequence[tuple[str, str]], state: str, term: str, who: str
) -> int:
    """Index of the coefficient (state, term); `who`, such as a relation, is named in errors."""
    try:
        name = library.names[library.index(term)]
    except ValueError as error:
        raise ValueError(f"{who}: {error}") from error
    if (state, name) in coefficients:
        return coefficients.index((state, name))
    support = [t for s, t in coefficients if s == state]
    if not support:
        states = list(dict.fromkeys(s for s, _ in coefficients))
        raise ValueError(f"{who}: unknown state {state!r}; the support has terms for {states}")
    raise ValueError(
        f"{who}: {name!r} is not in the support of {state!r}, {support}; add it there, or leave "
        "it out here"
    )


def _round(sums: np.ndarray | float, sizes: np.ndarray | float) -> np.ndarray:
    """Set sums to zero that cancel within rounding; `sizes` are the sums of absolute addends."""
    return np.where(np.abs(sums) <= ROUNDING * sizes, 0.0, sums)


def relations_of(relations: Sequence[Relation | str]) -> tuple[Relation, ...]:
    """Parse relations given as texts; leave the others as they are."""
    check_list("relations", relations)
    return tuple(parse_relation(r) if isinstance(r, str) else r for r in relations)


def binding(relations: Sequence[Relation], support: Support) -> tuple[Relation, ...] | None:
    """Relations whose terms are all in a support; None if the support violates a relation.

    A relation with value zero holds trivially if all of its terms are absent. If only some are
    absent, it would force the others to vanish as well, so the support violates it.
    """
    found = []
    for relation in relations:
        present = [term in support.get(state, ()) for _, state, term in relation.factors]
        if all(present):
            found.append(relation)
        elif any(present) or relation.value != 0.0:
            return None
    return tuple(found)


def complete(
    masks: Bool[np.ndarray, "supports terms"],
    library: NamedTerms,
    equation: str,
    relations: Sequence[Relation],
) -> Bool[np.ndarray, "_ terms"]:
    """Adapt candidate supports of one equation to the relations, without duplicates.

    Terms of a relation with a nonzero value are added to every support. Terms of a relation with
    value zero are in a support all together or not at all; both versions are kept.
    Raises ValueError for a term that the library does not have.
    """
    for relation in relations:
        named = [library.index(t) for _, state, t in relation.factors if state == equation]
        if not named:
            continue
        whole = masks.copy()
        whole[:, named] = True
        without = masks[~masks[:, named].any(axis=1)]
        masks = whole if relation.value != 0.0 else np.concatenate([without, whole])
    return np.unique(masks, axis=0)
