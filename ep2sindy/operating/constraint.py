"""Relations between the coefficients of a law, and coefficients known at every operating point."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from jaxtyping import Float

from ep2sindy.library.library import Library, named_terms
from ep2sindy.library.relations import Constraint, Relation, constraint, relations_of
from ep2sindy.runtime.values import read_only

# State -> term -> function of the parameters -> its factor, as in `OperatingLaw.numbers`.
Known = Mapping[str, Mapping[str, Mapping[str, float]]]
NOTHING: Known = MappingProxyType({})


@dataclass(frozen=True, eq=False)
class LawConstraint:
    """Relations that hold at every operating point: coef = C z + D @ functions(parameters), in SI.

    common: names of the coefficients, the free ones z, and C; its d is zero. functions: of the
    parameters. D: the known part of every coefficient. texts: the relations, one text for each.
    """

    common: Constraint
    functions: Library
    D: Float[np.ndarray, "coefs functions"]
    texts: tuple[str, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "D", read_only(self.D))
        assert self.D.shape == (len(self.common.coefficients), len(self.functions))

    @property
    def n_free(self) -> int:
        return len(self.common.free)

    def at(self, points: Float[np.ndarray, "points parameters"]) -> list[Constraint]:
        """The relations at each point, with the values that known coefficients have there.

        Raises ValueError for a point at which one of these is zero or not finite.
        """
        d = self.functions.evaluate(points) @ self.D.T
        known = d[:, ~self.common.C.any(axis=1)]
        for point, values in zip(points.tolist(), known, strict=True):
            if not (np.isfinite(values) & (values != 0.0)).all():
                where = dict(zip(self.functions.variables, point, strict=True))
                raise ValueError(
                    "known coefficients must be finite and not zero at every operating point: "
                    f"{values.tolist()} came at {where}; leave the term or the point out"
                )
        return [replace(self.common, d=values) for values in d]

    def law(
        self,
        functions: Library,
        free: Float[np.ndarray, "free functions"],
        covariance: Float[np.ndarray, "_ _"] | None,
    ) -> tuple[Library, Float[np.ndarray, "coefs joined"], Float[np.ndarray, "_ _"] | None]:
        """The law of all coefficients from that of the free ones, which obeys the relations.

        covariance: of free.ravel(). Returns the functions, followed by those in which known
        coefficients are expressed besides, the factors, and the covariance of their ravel(), which
        is zero for known ones.
        """
        used = np.flatnonzero(self.D.any(axis=0))
        joined = functions + self.functions.take(used) if used.size else functions
        spread = np.kron(self.common.C, np.eye(len(joined), len(functions)))
        coef = (spread @ free.ravel()).reshape(-1, len(joined))
        coef[:, [joined.index(self.functions.names[k]) for k in used]] += self.D[:, used]
        return joined, coef, None if covariance is None else spread @ covariance @ spread.T


def law_constraint(
    library: Library,
    structure: Mapping[str, Sequence[str]],
    relations: Sequence[Relation | str] = (),
    known: Known = NOTHING,
    *,
    parameters: Sequence[str],
) -> LawConstraint:
    """Eliminate one coefficient of the structure per relation and per known coefficient.

    relations: as for `constraint`. known: coefficients as sums of functions of the parameters, in
    SI, such as `{"n_n": {"1": {"mdot_mg_s": 4.6e22}}}` for an inflow of neutrals.
    Raises ValueError for relations that `constraint` refuses, for a function that is not of the
    parameters or has no finite factor, or if no coefficient is left free.
    """
    given = relations_of(relations)
    functions = named_terms(list(parameters), ["1"])
    told = {}
    for state, terms in known.items():
        for term, factors in terms.items():
            own = _known_functions(parameters, f"{state}: {term}", factors)
            functions = functions + own
            told[state, str(term)] = dict(zip(own.names, factors.values(), strict=True))
    columns = []
    for name in functions.names:
        # Relations are linear in their values: one function of the parameters at a time.
        values = [replace(r, value=r.value if name == "1" else 0.0) for r in given]
        values += [
            Relation(((1.0, state, term),), factors.get(name, 0.0), _text(state, term, factors))
            for (state, term), factors in told.items()
        ]
        columns.append(constraint(library, structure, values))
    common = replace(columns[0], d=np.zeros(len(columns[0].d)))
    texts = [r.text for r in given] + [_text(*pair, factors) for pair, factors in told.items()]
    if not len(common.free):
        raise ValueError(f"a law needs a free coefficient: {texts} leave none; drop one of them")
    return LawConstraint(common, functions, np.column_stack([c.d for c in columns]), tuple(texts))


def _known_functions(
    parameters: Sequence[str], coefficient: str, factors: Mapping[str, float]
) -> Library:
    try:
        return named_terms(list(parameters), list(map(str, factors)))
    except ValueError as error:
        raise ValueError(
            f"the known coefficient {coefficient} must be a sum of functions of "
            f"{list(parameters)}, such as {{{parameters[-1]}: 2.0}}: {error}"
        ) from error


def _text(state: str, term: str, factors: Mapping[str, float]) -> str:
    """`n_n: 1 == 4.6e+22 * mdot_mg_s`, each number in its shortest exact form."""
    addends = [repr(v) if name == "1" else f"{v!r} * {name}" for name, v in factors.items()]
    return f"{state}: {term} == {' + '.join(addends)}"
