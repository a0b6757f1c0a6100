"""The library of candidate terms: construction, evaluation, scaling, derivatives and display."""

from __future__ import annotations

import html
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations_with_replacement
from typing import Any

import numpy as np
from array_api_compat import array_namespace
from jaxtyping import Bool, Float, Int

from ep2sindy.library.facts import Facts, Known
from ep2sindy.library.functions import Function, variable_factor
from ep2sindy.library.names import check_state
from ep2sindy.library.relations import Relation, relations_of
from ep2sindy.library.roles import Roles
from ep2sindy.library.terms import (
    Term,
    check_degrees,
    check_exponents,
    check_values,
    functions_named,
    product,
    read_term,
)
from ep2sindy.runtime.screen import N_LINES, cut, html_table, near_words, one_screen, wrap
from ep2sindy.runtime.values import check_list


@dataclass(frozen=True, eq=False)
class Library:
    """Ordered candidate terms, each a product of powers of variables and of functions of them.

    A library also holds facts, that is, what is known of the equations. `relate`, `only`,
    `exclude`, `known` and `with_roles` each return a new library with one more fact. A fact that is
    given twice counts once, and facts that contradict each other are refused. Models keep only the
    terms, and so does `take`. `polynomial` and `named_terms` make libraries.

    Parameters
    ----------
    variables : sequence of str
        Names of the variables, states first.
    exponents : (terms, factors) int array
        Powers of the variables, then of the functions, in each term. They are not negative. A row
        of zeros is the constant.
    functions : sequence of Function, default ()
        The factors that are not variables. Without them every term is a monomial.
    facts : Facts, default Facts()
        What is known of the equations.

    Raises
    ------
    ValueError
        If a variable or a term is repeated, a variable's name is invalid, there is no term, or a
        fact names an unknown term.

    Notes
    -----
    Term k is the product of `x_j^exponents[k, j]` over the variables and functions x_j. Names of
    terms are `1`, `n_i`, `n_i*n_n`, `n_i^2`, with factors in the order of the variables.

    Examples
    --------
    >>> library = ep.polynomial(["x", "y"], degree=2).exclude({"x": ["x^2"]})
    >>> library.relate("x: x*y == -1 * y: x*y")
    Library of 6 terms over x, y
    1 of degree 0: 1
    2 of degree 1: x y
    3 of degree 2: x^2 x*y y^2
    known: x: x*y == -1 * y: x*y
    known: x' has no x^2
    """

    variables: Sequence[str]
    exponents: Int[np.ndarray, "terms factors"]
    functions: Sequence[Function] = ()
    facts: Facts = field(default_factory=Facts)

    def __post_init__(self) -> None:
        check_list("variables", self.variables)
        exponents = np.array(self.exponents, dtype=np.int64)
        exponents.flags.writeable = False
        object.__setattr__(self, "variables", tuple(self.variables))
        object.__setattr__(self, "functions", tuple(self.functions))
        object.__setattr__(self, "exponents", exponents)
        for name in self.variables:
            check_state(name)
        if len(set(self.variables)) < len(self.variables):
            raise ValueError(f"variables must be unique: {list(self.variables)}")
        if not len(exponents):
            raise ValueError("a library needs at least one term, got none")
        if len(set(map(tuple, exponents.tolist()))) < len(exponents):
            raise ValueError(f"terms must be unique: {list(self.names)}")
        self.facts.check(self)

    def __len__(self) -> int:
        return len(self.exponents)

    def __add__(self, other: Library) -> Library:
        """Join two libraries over the same variables; each term appears once, in order.

        What is known by either holds.
        """
        if other.variables != self.variables:
            raise ValueError(
                f"libraries to be joined must share their variables: {list(self.variables)} "
                f"against {list(other.variables)}"
            )
        joined = library_of(self.variables, [*self.terms, *other.terms])
        return replace(joined, facts=self.facts | other.facts)

    def relate(self, *relations: Relation | str) -> Library:
        """With linear relations of coefficients, `"x: x*y == -1 * y: x*y"` or `"x: y == 1"`.

        They hold in the search, in the selection and in the model; numbers are in SI.
        """
        return self._knowing(Facts(relations=relations_of(relations)))

    def only(self, terms: Mapping[str, Sequence[str]]) -> Library:
        """With equations that are known but for their coefficients: state -> all of its terms."""
        return self._knowing(Facts(only=terms))

    def exclude(self, terms: Mapping[str, Sequence[str]]) -> Library:
        """With terms that an equation may not have, such as {"x": ["x^2"]}."""
        return self._knowing(Facts(excluded=terms))

    def known(self, coefficients: Known) -> Library:
        """With coefficients that are known functions of the operating point, in SI.

        Such as {"n_n": {"1": {"mdot_mg_s": 4.6e22}}}, of runs with these `Trajectory.parameters`.
        """
        return self._knowing(Facts(known=coefficients))

    def with_roles(self, roles: Roles | None) -> Library:
        """With roles of terms, for equations that conserve what states exchange; see `Roles`.

        None: without the roles that were given.
        """
        if roles is None:
            return replace(self, facts=replace(self.facts, roles=None))
        return self._knowing(Facts(roles=roles))

    def _knowing(self, more: Facts) -> Library:
        return replace(self, facts=self.facts | more)

    @cached_property
    def plain(self) -> Library:
        """The terms alone, without what is known."""
        known = any(vars(self.facts).values())
        return Library(self.variables, self.exponents, self.functions) if known else self

    def allowed(self, state: str) -> Bool[np.ndarray, " terms"]:
        """Mask of the terms that the equation of a state may have."""
        mask = np.ones(len(self), dtype=np.bool_)
        mask[[self.index(name) for name in self.facts.excluded.get(state, ())]] = False
        return mask

    def at_operating_point(self, parameters: Mapping[str, float]) -> Library:
        """This library with numbers in place of what is known by functions of the point."""

        def value_of(coefficient: str, factors: Mapping[str, float]) -> float:
            functions = functions_of_point(list(parameters), coefficient, factors)
            values = functions.evaluate(np.array([*parameters.values()]))
            return float(values @ np.array([*factors.values()]))

        roles = self.facts.roles
        if roles is not None and roles.by_point:
            inflow = {state: value_of(f"{state} in", f) for state, f in roles.by_point.items()}
            own = replace(roles, inflow={**roles.inflow, **inflow})
            return replace(self, facts=replace(self.facts, roles=own))
        known = []
        for (state, term), factors in self.facts.known_factors.items():
            value = value_of(f"{state}: {term}", factors)
            known.append(Relation(((1.0, state, term),), value, f"{state}: {term} == {value!r}"))
        return replace(self, facts=replace(self.facts, known={})).relate(*known) if known else self

    def with_known_terms(self, states: Sequence[str]) -> Library:
        """With all terms of equations that the roles know; those added stand in no other.

        Raises ValueError for a term of something that is no variable or state.
        """
        known = self.facts.roles.known if self.facts.roles else {}
        missing = dict.fromkeys(term for _, term in known if term not in self.names)
        if not missing:
            return self
        variables = tuple(dict.fromkeys([*self.variables, *states]))
        more = [read_term(term, variables) for term in missing]
        return replace(library_of(variables, [*self.terms, *more]), facts=self.facts)

    @cached_property
    def terms(self) -> tuple[Term, ...]:
        factors = [*map(variable_factor, self.variables), *self.functions]
        return tuple(
            product({f: p for f, p in zip(factors, row, strict=True) if p}, self.variables)
            for row in self.exponents.tolist()
        )

    @cached_property
    def names(self) -> tuple[str, ...]:
        return tuple(term.name for term in self.terms)

    @cached_property
    def degrees(self) -> Int[np.ndarray, " terms"]:
        """Number of factors of every term."""
        return self.exponents.sum(axis=1)

    @cached_property
    def table(self) -> Int[np.ndarray, "terms degree"]:
        """Indices of the columns that each term multiplies: variables, a one, then functions.

        The one fills up rows of terms with fewer factors.
        """
        n = len(self.variables)
        columns = np.delete(np.arange(self.exponents.shape[1] + 1), n)
        table = np.full((len(self), max(1, int(self.degrees.max()))), n)
        for row, powers in zip(table, self.exponents, strict=True):
            factors = np.repeat(columns, powers)
            row[: len(factors)] = factors
        return table

    def __repr__(self) -> str:
        """Terms by degree, and what is known, as text that fits one screen."""
        lines = [f"Library of {len(self)} terms over {', '.join(self.variables)}"]
        by_degree = list(self._by_degree.items())
        for k, (degree, found) in enumerate(by_degree):
            left = N_LINES - len(lines) - (len(by_degree) - k - 1)
            head = f"{len(found)} of degree {degree}:"
            lines += wrap([head, *found], what="terms", n_lines=max(1, min(6, left)))
        return one_screen([*lines, *(f"known: {line}" for line in self.facts.lines)])

    def _repr_html_(self) -> str:
        """Terms by degree, and what is known, as a table."""
        rows = [
            [str(degree), str(len(found)), html.escape(cut(", ".join(found), 1000))]
            for degree, found in self._by_degree.items()
        ]
        rows += [["known", "", html.escape(cut(line, 1000))] for line in self.facts.lines]
        return html_table(["degree", "terms", ""], rows)

    @property
    def _by_degree(self) -> dict[int, list[str]]:
        pairs = [*zip(self.degrees.tolist(), self.names, strict=True)]
        return {d: [n for k, n in pairs if k == d] for d in sorted({k for k, _ in pairs})}

    def index(self, name: str) -> int:
        """Position of a term; factors may come in any order. Raises ValueError if absent."""
        if name in self._named:
            return self._named[name]
        term = read_term(name, self.variables)
        if term not in self._places:
            raise ValueError(
                f"unknown term {name!r}; this library has {list(self.names)}"
                f"{near_words(name, self.names)}"
            )
        return self._places[term]

    def places(self, other: Library) -> list[int]:
        """Positions in this library of the terms of another one over the same variables."""
        return [self._places[term] for term in other.terms]

    def units(self, units: Mapping[str, str]) -> tuple[str, ...]:
        """Unit of every term, from the units of the variables."""
        return tuple(term.unit(units) for term in self.terms)

    def take(self, rows: np.ndarray) -> Library:
        """Sub-library of some terms, by position or mask, with only the functions they need.

        What is known of equations is left out.
        """
        n, exponents = len(self.variables), self.exponents[rows]
        used = np.flatnonzero(exponents[:, n:].any(axis=0))
        kept, functions = [*range(n), *(n + used)], [self.functions[k] for k in used.tolist()]
        return Library(self.variables, exponents[:, kept], functions)

    def over(self, variables: Sequence[str]) -> Library:
        """The same terms over other variables, which must include all that the terms use."""
        n = len(self.variables)
        padded = np.pad(self.exponents[:, :n], ((0, 0), (0, 1)))
        order = [self.variables.index(v) if v in self.variables else -1 for v in variables]
        exponents = np.concatenate([padded[:, order], self.exponents[:, n:]], axis=1)
        return Library(variables, exponents, self.functions)

    def scaled(
        self, scale: Float[np.ndarray, " variables"]
    ) -> tuple[Library, Float[np.ndarray, " terms"]]:
        """Library for variables divided by `scale`, and factors that convert its terms to SI."""
        own = scale[self._arguments].tolist()
        pairs = [f.scaled(s) for f, s in zip(self.functions, own, strict=True)]
        numbers = np.append(scale, [number for number, _ in pairs])
        functions = [function for _, function in pairs]
        scaled = Library(self.variables, self.exponents, functions)
        return scaled, np.prod(numbers**self.exponents, axis=1)

    def evaluate(self, values: Any) -> Any:
        """Evaluate every term at every sample.

        Parameters
        ----------
        values : array or torch tensor (..., variables)
            Samples, in the order of `variables`.

        Returns
        -------
        (..., terms) array or torch tensor
            The terms, of the same kind.
        """
        check_values(len(self), values.shape)
        xp = array_namespace(values)
        columns = xp.concat([values, xp.ones_like(values[..., :1])], axis=-1)
        columns = self.with_functions(columns, axis=-1)
        theta = columns[..., self.table[:, 0]]
        for factors in self.table.T[1:]:
            theta = theta * columns[..., factors]
        return theta

    def with_functions(self, columns: Any, *, axis: int) -> Any:
        """Append the functions' columns to those of the variables and a one, along any axis.

        A term is then the product of the columns in its row of `table`.
        """
        if not self.functions:
            return columns
        xp = array_namespace(columns)
        of = [xp.take(columns, xp.asarray([k]), axis=axis) for k in self._arguments]
        with np.errstate(all="ignore"):  # callers check for values outside a function's domain
            values = [f.value(x) for f, x in zip(self.functions, of, strict=True)]
        return xp.concat([columns, *values], axis=axis)

    def at_points(self) -> tuple[Float[np.ndarray, " variables"], Callable[[], np.ndarray]]:
        """Evaluate terms at one point after another, for solvers: one gather and product per call.

        Returns an array to be filled with the variables, and a function that evaluates the terms at
        the current content of that array.
        """
        n, table = len(self.variables), self.table
        columns = np.ones(n + 1 + len(self.functions))
        functions = [*zip(range(n + 1, len(columns)), self.functions, self._arguments, strict=True)]

        def terms() -> np.ndarray:
            for place, function, argument in functions:
                columns[place] = function.at(columns[argument])
            return columns[table].prod(axis=1)

        return columns[:n], terms

    def with_derivatives(
        self, n: int
    ) -> tuple[Library, Float[np.ndarray, "terms columns products"]]:
        """Terms and their derivatives by the first n variables, as sums of distinct products.

        Returns a library of these products, sorted by ascending exponents, and weights of shape
        (terms, 1 + n, products), which combine the products to each term and its n derivatives.
        """
        if n not in self._derived:
            self._derived[n] = self._derive(n)
        return self._derived[n]

    def _derive(self, n: int) -> tuple[Library, np.ndarray]:
        slopes = [[{term: 1.0}, *map(term.derivative, self.variables[:n])] for term in self.terms]
        distinct = list(dict.fromkeys(t for sums in slopes for parts in sums for t in parts))
        unsorted = library_of(self.variables, distinct)
        order = np.lexsort(unsorted.exponents.T[::-1])
        places = {distinct[k]: place for place, k in enumerate(order.tolist())}
        weights = np.zeros((len(self), 1 + n, len(distinct)))
        for row, sums in zip(weights, slopes, strict=True):
            for column, parts in zip(row, sums, strict=True):
                for term, weight in parts.items():
                    column[places[term]] = weight
        return unsorted.take(order), weights

    @cached_property
    def _named(self) -> dict[str, int]:
        return {name: k for k, name in enumerate(self.names)}

    @cached_property
    def _places(self) -> dict[Term, int]:
        return {term: k for k, term in enumerate(self.terms)}

    @cached_property
    def _arguments(self) -> list[int]:
        """Index of the variable that each function takes."""
        return [self.variables.index(f.variable) for f in self.functions]

    @cached_property
    def _derived(self) -> dict[int, tuple[Library, np.ndarray]]:
        return {}


def library_of(variables: Sequence[str], terms: Iterable[Term]) -> Library:
    """Library of these terms in this order, without repetitions."""
    distinct = list(dict.fromkeys(terms))
    used = (factor for term in distinct for factor, _ in term.factors)
    factors = list(dict.fromkeys([*map(variable_factor, variables), *used]))
    check_exponents(len(distinct), len(factors))
    places = {factor: k for k, factor in enumerate(factors)}
    exponents = np.zeros((len(distinct), len(factors)), dtype=np.int64)
    for row, term in zip(exponents, distinct, strict=True):
        for factor, power in term.factors:
            row[places[factor]] = power
    functions = [factor for factor in factors if not factor.is_variable]
    return Library(variables, exponents, functions)


def functions_of_point(
    parameters: Sequence[str], coefficient: str, factors: Mapping[str, float]
) -> Library:
    """Functions of the parameters by which a coefficient is known. Raises ValueError for others."""
    try:
        return named_terms(parameters, list(map(str, factors)))
    except ValueError as error:
        raise ValueError(
            f"the known coefficient {coefficient} must be a sum of functions of "
            f"{list(parameters)}, the Trajectory.parameters, such as {{p: 2.0}}: {error}"
        ) from error


def named_terms(variables: Sequence[str], names: Sequence[str]) -> Library:
    """Library of exactly the named terms, in this order.

    Parameters
    ----------
    variables : sequence of str
        Names of the variables, states first.
    names : sequence of str
        Names of the terms, such as `1`, `x*y`, `x^2` or `sin(x)`.

    Returns
    -------
    Library
        The terms.

    Raises
    ------
    ValueError
        If a term is repeated, or has an unknown variable or function.

    Examples
    --------
    >>> ep.named_terms(["x", "y"], ["x", "x*y"]).names
    ('x', 'x*y')
    """
    check_list("variables", variables)
    check_list("names", names)
    check_exponents(len(names), len(variables))
    terms = [read_term(name, variables) for name in names]
    if len(set(terms)) < len(terms):
        raise ValueError(f"terms must be unique: {[term.name for term in terms]}")
    return library_of(variables, terms)


def polynomial(
    variables: Sequence[str],
    *,
    degree: int = 2,
    products: Sequence[str] = (),
    functions: Sequence[str] = (),
    function_degree: int = 1,
) -> Library:
    """Library of all products of the variables up to a degree, including the constant.

    Terms are ordered by degree, then by variable, with functions last: 1, x, y, sin(x), x^2, ...

    Parameters
    ----------
    variables : sequence of str
        Names of the variables, states first.
    degree : int, default 2
        Largest number of factors in a product of variables.
    products : sequence of str, default ()
        Further terms by name, such as "x^3".
    functions : sequence of str, default ()
        A bare name such as `sin` applies to every variable. A function that is written out, such as
        `sin(2*x)` or `1/(0.5+x)`, is taken as it is.
    function_degree : int, default 1
        Largest number of factors in a term with a function: 1 gives functions by themselves, 2 also
        their products with a variable or with each other.

    Returns
    -------
    Library
        The terms.

    Raises
    ------
    ValueError
        If a degree is negative or not a whole number, or a variable or function is unknown.

    Examples
    --------
    >>> ep.polynomial(["x", "y"], degree=2).names
    ('1', 'x', 'y', 'x^2', 'x*y', 'y^2')
    >>> ep.polynomial(["x"], degree=1, functions=["sin"]).names
    ('1', 'x', 'sin(x)')
    """
    check_list("variables", variables)
    check_list("products", products)
    n, factors = len(variables), functions_named(functions, variables)
    check_degrees(degree, function_degree, n, len(factors))
    rows = [
        np.bincount(combination, minlength=n + len(factors))
        for k in range(max(degree, function_degree if factors else 0) + 1)
        for combination in map(list, combinations_with_replacement(range(n + len(factors)), k))
        if k <= (function_degree if combination and combination[-1] >= n else degree)
    ]
    full = Library(variables, np.array(rows, dtype=np.int64), factors)
    return full + named_terms(variables, products) if products else full
