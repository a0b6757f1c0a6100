"""Equations by process: what enters, is exchanged and leaves, with common factors taken out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from ep2sindy.library.names import factors_of, product_of
from ep2sindy.library.relations import Constraint
from ep2sindy.library.roles import process_amounts

IN, OUT = " in", " out"  # what enters is written first, and what leaves last
SEPARATE = (IN, " free", " known")  # roles whose terms are written one by one


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


Equations = Mapping[str, Mapping[str, float]]  # state -> term -> number
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
