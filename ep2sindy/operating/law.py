"""The law of the operating point: a model whose coefficients are functions of the point.

Relations between the coefficients, and coefficients that are known at every point, hold in it.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from scipy.optimize import nnls
from scipy.special import ndtri

from ep2sindy.data.numbers import zero_to_one
from ep2sindy.data.trajectory import point_label
from ep2sindy.library.equations import equation_text
from ep2sindy.library.library import Library, functions_of_point, named_terms
from ep2sindy.library.relations import Constraint, Process, Relation, constraint
from ep2sindy.library.roles import IN, Roles, constraint_of
from ep2sindy.model.model import SparseModel
from ep2sindy.model.storage import covariance_in, names_in, read_as, read_stored, texts_in
from ep2sindy.operating.records import check_varying, read_points, values_at
from ep2sindy.regression.constrained import place_coefficients
from ep2sindy.regression.pooled import Basis
from ep2sindy.runtime.files import write_text
from ep2sindy.runtime.values import read_only

FORMAT = "ep2sindy.OperatingLaw/1"

# The degree of polynomials of the parameters, functions of them, or those chosen of many.
LawFunctions = int | Library | Literal["auto"]

INSIDE = 1e-6  # tolerance of the hull, in ranges of the parameters


@dataclass(frozen=True, eq=False)
class OperatingLaw:
    """One set of equations whose coefficients are functions of the operating point.

    `ep.discover(runs, law=1).law` is one; `PointFits.law` fits it.

    Parameters
    ----------
    functions : Library
        Functions of the parameters.
    library : Library
        Terms over the states.
    states : tuple of str
        Names of the states.
    coefficients : tuple of (str, str)
        (state, term) of each row of coef.
    coef : (coefs, functions) array
        Factor of each function in each coefficient, in SI.
    points : (points, parameters) array
        The operating points of the fit, with columns in the order of the functions' variables.
    covariance : (n, n) array, optional
        Covariance of coef.ravel(). None if it is unknown.
    units : mapping of str to str, default {}
        Units of the states.
    provenance : mapping of str to str, default {}
        Record of how the law was found.
    left_out : (points,) array, optional
        For each point, the error of the rates that the law of the other points predicts for it, as
        a fraction of its rates. None if the points do not suffice for a law without each of them.

    Raises
    ------
    ValueError
        If shapes do not fit, numbers are not finite, or a coefficient is of an unknown state or
        term.

    Notes
    -----
    At the operating point p, the coefficients are

        c(p) = W f(p),   under relations c(p) = C W f(p) + D g(p)

    with C and D of a `LawConstraint`; `coef` holds the whole, by the functions f and g. Assumes
    that the same terms act at every point, and coefficients smooth enough for f.

    Source: Rudy et al. 2019, doi:10.1137/18M1191944, for coefficients that depend on a parameter.

    Examples
    --------
    >>> functions, library = ep.polynomial(["a"], degree=1), ep.polynomial(["x"], degree=1)
    >>> pairs, points = (("x", "x"),), np.array([[0.0], [2.0]])
    >>> coef = np.array([[0.0, -1.0]])  # x' = -a x
    >>> law = ep.operating.OperatingLaw(functions, library, ("x",), pairs, coef, points)
    >>> law.at(a=0.5).text()
    "x' = -0.5 x"
    """

    functions: Library
    library: Library
    states: tuple[str, ...]
    coefficients: tuple[tuple[str, str], ...]
    coef: Float[np.ndarray, "coefs functions"]
    points: Float[np.ndarray, "points parameters"]
    covariance: Float[np.ndarray, "_ _"] | None = None
    units: Mapping[str, str] = field(default_factory=dict)
    provenance: Mapping[str, str] = field(default_factory=dict)
    left_out: Float[np.ndarray, " _"] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "coef", read_only(self.coef))
        object.__setattr__(self, "points", read_only(self.points))
        if self.left_out is not None:
            object.__setattr__(self, "left_out", read_only(self.left_out))
            if self.left_out.shape != (len(self.points),):
                raise ValueError(
                    f"left_out must have an error for each of {len(self.points)} points, got shape "
                    f"{self.left_out.shape}"
                )
        object.__setattr__(self, "units", MappingProxyType(dict(self.units)))
        object.__setattr__(self, "provenance", MappingProxyType(dict(self.provenance)))
        shape = (len(self.coefficients), len(self.functions))
        if self.coef.shape != shape or not np.isfinite(self.coef).all():
            raise ValueError(
                "a law must have a finite number for every coefficient and function, got shape "
                f"{self.coef.shape} for {shape}"
            )
        for state, term in self.coefficients:
            if state not in self.states or term not in self.library.names:
                raise ValueError(
                    f"a law's coefficients must be of {list(self.states)} and "
                    f"{list(self.library.names)}, got {term} of {state}"
                )
        if self.points.shape[1:] != (len(self.parameters),) or not len(self.points):
            raise ValueError(
                f"points must have a column for each of {list(self.parameters)}, got shape "
                f"{self.points.shape}"
            )
        if not np.isfinite(self.points).all():
            raise ValueError(f"points must be finite, got {self.points.tolist()}")
        if self.covariance is not None:
            object.__setattr__(self, "covariance", read_only(self.covariance))
            if self.covariance.shape != (self.coef.size, self.coef.size):
                raise ValueError(
                    f"the covariance must be that of {self.coef.size} numbers, got shape "
                    f"{self.covariance.shape}"
                )

    @property
    def parameters(self) -> tuple[str, ...]:
        return tuple(self.functions.variables)

    @property
    def numbers(self) -> dict[str, dict[str, dict[str, float]]]:
        """State -> term -> function -> the factor of that function in the term's coefficient."""
        found: dict[str, dict[str, dict[str, float]]] = {state: {} for state in self.states}
        for (state, term), row in zip(self.coefficients, self.coef.tolist(), strict=True):
            found[state][term] = dict(zip(self.functions.names, row, strict=True))
        return found

    def at(self, *, extrapolate: bool = False, **parameters: float) -> SparseModel:
        """The model at an operating point, which need not be one of the fitted points.

        Parameters
        ----------
        extrapolate : bool, default False
            True allows points outside the convex hull of the fitted points; the model's provenance
            then records that it is extrapolated.
        **parameters : float
            A value for each parameter of the law, as in `at(V_D_V=330, mdot_mg_s=4.6)`.

        Returns
        -------
        SparseModel
            The equations at that point.

        Raises
        ------
        ValueError
            If parameters are missing or unknown, values are not finite, or the point lies outside
            the convex hull of the fitted points without `extrapolate`.
        """
        (values,) = read_points([parameters], self.parameters)
        label, inside = point_label(parameters), in_hull(self.points, values)
        if not extrapolate and not inside:
            raise outside(
                label, self.parameters, self.points, "law",
                "pass extrapolate=True to read it off the law all the same",
            )  # fmt: skip
        functions = self.functions.evaluate(values[None])[0]
        at_point = self.coef @ functions
        coef, used = place_coefficients(self.library, self.states, self.coefficients, at_point)
        covariance = None
        if self.covariance is not None:
            spread = np.kron(np.eye(len(at_point)), functions)[used]
            covariance = spread @ self.covariance @ spread.T
        where = label if inside else f"{label}, extrapolated"
        provenance = {**self.provenance, "point": where}
        return SparseModel(self.library, self.states, coef, self.units, provenance, covariance)

    def is_inside(self, point: Mapping[str, float]) -> bool:
        """True if a point lies in the convex hull of the fitted points."""
        return in_hull(self.points, values_at([point], self.parameters)[0])

    def intervals(self, *, level: float = 0.95) -> dict[tuple[str, str], dict[str, Any]]:
        """(state, term) -> function -> lower and upper bound of its factor, for Gaussian errors.

        Raises ValueError for a law without covariance.
        """
        if self.covariance is None:
            raise ValueError(
                "intervals need a covariance: this law has none, since its points do not suffice "
                "for a law without each of them; add points, or take a law of fewer functions"
            )
        std = np.sqrt(np.maximum(np.diag(self.covariance), 0.0)).reshape(self.coef.shape)
        reach = ndtri(0.5 + 0.5 * level) * std
        ends = np.stack([self.coef - reach, self.coef + reach], axis=-1).tolist()
        return {
            pair: {name: (*each,) for name, each in zip(self.functions.names, row, strict=True)}
            for pair, row in zip(self.coefficients, ends, strict=True)
        }

    @property
    def undetermined(self) -> list[tuple[str, str]]:
        """The (state, term) whose 95 % intervals hold zero at most of the points.

        Neither the count of the numbers nor errors of the rates at points left out tell them:
        terms that make up for each other follow the rates as well as one of them alone. The
        jackknife does, as such coefficients move together when a point is left out. Of van der Pol
        laws with 6 to 9 terms of which 4 are true, at 5 to 12 points, nearly all coefficients that
        are wrong by half or more are among these, at any degree of the law, and none of a law of
        the true terms; from eight points on, the errors left out differ by a factor of two at most.
        Empty without covariance.
        """
        if self.covariance is None:
            return []
        at_points = self.functions.evaluate(self.points)
        parts = self.covariance.reshape(*self.coef.shape, *self.coef.shape)
        variance = np.einsum("kfkg,pf,pg->kp", parts, at_points, at_points)
        reach = ndtri(0.975) * np.sqrt(np.maximum(variance, 0.0))
        lost = (np.abs(self.coef @ at_points.T) < reach).mean(axis=1) > 0.5
        return [pair for pair, is_lost in zip(self.coefficients, lost, strict=True) if is_lost]

    @property
    def doubt(self) -> str:
        """That the points determine the numbers of the law poorly, in words; empty if they do not.

        So it is without points to spare, and with coefficients that are `undetermined`.
        """
        counts = f"{self.coef.size} numbers of {len(self.points)} points"
        if self.covariance is None and len(self.points) <= len(self.functions):
            return f"{counts}: none is left over to tell how well they are determined"
        lost = [f"{state}: {term}" for state, term in self.undetermined]
        if not lost:
            return ""
        return (
            f"{counts}: of {len(self.coef)} coefficients, {len(lost)} are not told from zero, "
            f"{', '.join(lost)}; leave terms out, or add points"
        )

    def text(self, *, digits: int = 3) -> str:
        """One line per coefficient: `n_i: n_n = 4.83e+03 + 12.1 V_d`.

        The relations that the coefficients obey follow, each in full: `exact: n_n: 1 == 2.0 * V_d`,
        the errors at points left out, and coefficients that the points do not determine.
        """
        numbers = self.numbers
        lines = []
        for state, term in self.coefficients:
            factors = {name: value for name, value in numbers[state][term].items() if value != 0.0}
            right = equation_text("c", factors, digits=digits).partition("= ")[2]
            lines.append(f"{state}: {term} = {right}")
        exact = self.provenance.get("exact", "")
        lines += [f"exact: {each}" for each in exact.split("; ") if each]
        if self.left_out is not None:
            lines.append(
                "points left out one at a time: the rates err by "
                f"{100.0 * np.median(self.left_out):.2g} % in the median, "
                f"{100.0 * self.left_out.max():.2g} % at most"
            )
        lines += [self.doubt] if self.doubt else []
        return "\n".join(lines)

    def __repr__(self) -> str:
        head = (
            f"OperatingLaw of {len(self.coefficients)} coefficients in {list(self.parameters)}, "
            f"{self.coef.size} numbers, {len(self.points)} points"
        )
        return f"{head}\n{self.text()}"

    def to_json(self) -> str:
        """The complete law as JSON; floats in their shortest exact form."""
        content = {
            "format": FORMAT,
            "parameters": list(self.parameters),
            "functions": list(self.functions.names),
            "variables": list(self.library.variables),
            "library": list(self.library.names),
            "states": list(self.states),
            "coefficients": [list(pair) for pair in self.coefficients],
            "coef": self.coef.tolist(),
            "points": self.points.tolist(),
            "covariance": None if self.covariance is None else self.covariance.tolist(),
            "units": dict(self.units),
            "provenance": dict(self.provenance),
            "left_out": None if self.left_out is None else self.left_out.tolist(),
        }
        return json.dumps(content, indent=2, allow_nan=False) + "\n"

    @staticmethod
    def from_json(text: str) -> OperatingLaw:
        """Inverse of `to_json`, exact. Raises ValueError for anything else."""
        with read_as("a law file must hold", FORMAT, text) as content:
            known, left_out = content["covariance"], content["left_out"]
            return OperatingLaw(
                functions=named_terms(*(names_in(content[k]) for k in ("parameters", "functions"))),
                library=named_terms(*(names_in(content[k]) for k in ("variables", "library"))),
                states=tuple(names_in(content["states"])),
                coefficients=tuple((state, term) for state, term in content["coefficients"]),
                coef=np.array(content["coef"], dtype=np.float64),
                points=np.array(content["points"], dtype=np.float64),
                covariance=None if known is None else covariance_in(known),
                units=texts_in(content["units"], "units"),
                provenance=texts_in(content["provenance"], "provenance"),
                left_out=None if left_out is None else np.array(left_out, dtype=np.float64),
            )

    def save(self, path: str | Path) -> None:
        write_text(Path(path), self.to_json())

    @staticmethod
    def load(path: str | Path) -> OperatingLaw:
        return read_stored(Path(path), OperatingLaw.from_json)


def read_law(law: OperatingLaw, point: Mapping[str, float]) -> SparseModel:
    """The law's model at a point, extrapolated if need be; the point may have more parameters."""
    return law.at(extrapolate=True, **{name: point[name] for name in law.parameters})


def in_hull(
    points: Float[np.ndarray, "points parameters"], value: Float[np.ndarray, " parameters"]
) -> bool:
    """True if a value lies in the convex hull of points."""
    scale = zero_to_one(np.ptp(points, axis=0))
    columns = np.vstack([((points - value) / scale).T, np.ones(len(points))])
    target = np.append(np.zeros(points.shape[1]), 1.0)
    return float(nnls(columns, target)[1]) <= INSIDE


def outside(
    label: str,
    parameters: Sequence[str],
    points: Float[np.ndarray, "points parameters"],
    what: str,
    remedy: str,
) -> ValueError:
    """The error of a point that lies outside the points to which something was fitted."""
    ranges = zip(parameters, points.min(axis=0), points.max(axis=0), strict=True)
    return ValueError(
        f"{label} lies outside the points that this {what} was fitted to, "
        f"{', '.join(f'{name} {low:g} to {high:g}' for name, low, high in ranges)}: {remedy}"
    )


def make_basis(
    functions: Library,
    points: Float[np.ndarray, "points parameters"],
    *,
    n_spare: int = 0,
    remedy: str = "leave it out, or add points",
) -> Basis:
    """The functions of a law at the points of its fit, with the checks common to all laws.

    points: columns in the order of the functions' variables. n_spare: number of points required
    beyond the number of functions. remedy: advice on a parameter that does not vary.
    Raises ValueError if the points do not suffice, naming the parameter if one is to blame.
    """
    try:
        if n_spare and len(points) < len(functions) + n_spare:
            raise ValueError(
                f"a law of {len(functions)} functions of {list(functions.variables)} needs "
                f"{len(functions) + n_spare} points or more, since each is left out in turn, got "
                f"{len(points)}"
            )
        return Basis(functions.evaluate(points))
    except ValueError:
        check_varying(points, functions.variables, remedy=remedy)
        raise


@dataclass(frozen=True, eq=False)
class LawConstraint:
    """Relations that hold at every operating point p: c(p) = C z(p) + D g(p), in SI.

    With a law z(p) = W f(p) of the free coefficients, the factors of W obey c(p) = C_p W.ravel() +
    d_p: a constraint whose C_p = kron(C, f(p)) and d_p = D g(p) depend on the point.

    common: names of the coefficients, the free ones z, and C; its d is zero. functions: g, of the
    parameters. D: the known part of every coefficient. texts: the relations, one text for each.
    inflow: state -> function -> factor, of roles that are known by the point.
    """

    common: Constraint
    functions: Library
    D: Float[np.ndarray, "coefs functions"]
    texts: tuple[str, ...]
    inflow: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "D", read_only(self.D))
        assert self.D.shape == (len(self.common.coefficients), len(self.functions))

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
                    "known coefficients must be finite and not zero at every operating point, got "
                    f"{values.tolist()} at {where}; leave the term or the point out"
                )
        g = dict(zip(self.functions.names, self.functions.evaluate(points).T, strict=True))
        inflow = {s: sum(v * g[name] for name, v in f.items()) for s, f in self.inflow.items()}
        return [
            replace(
                self.common,
                d=values,
                known=tuple(_supplied(p, {s: x[k] for s, x in inflow.items()})
                            for p in self.common.known),
            )
            for k, values in enumerate(d)
        ]  # fmt: skip

    def make_law(
        self,
        model: SparseModel,
        functions: Library,
        points: Float[np.ndarray, "points parameters"],
        free: Float[np.ndarray, "free functions"],
        *,
        how: str,
    ) -> OperatingLaw:
        """The law of all coefficients from that of the free ones, which obeys the relations.

        model: at one of the points, for its library, states and units. how: the fit, for the
        provenance.
        """
        # Known coefficients may be expressed in further functions, which follow the given ones.
        used = np.flatnonzero(self.D.any(axis=0))
        joined = functions + self.functions.take(used) if used.size else functions
        coef = self.common.C @ free @ np.eye(len(functions), len(joined))
        coef[:, [joined.index(self.functions.names[k]) for k in used]] += self.D[:, used]
        provenance = {"law": f"{how}, {len(points)} points"}
        if self.texts:
            provenance["exact"] = "; ".join(self.texts)
        return OperatingLaw(
            functions=joined,
            library=model.library,
            states=self.common.states,
            coefficients=self.common.coefficients,
            coef=coef,
            points=points,
            units=model.units,
            provenance=provenance,
        )


def constrain_law(
    library: Library,
    structure: Mapping[str, Sequence[str]],
    *,
    parameters: Sequence[str],
) -> LawConstraint:
    """Eliminate one coefficient of the structure per relation and known coefficient of the library.

    Raises ValueError for relations that `constraint` refuses, for a function that is not of the
    parameters or has no finite factor, or if no coefficient is left free.
    """
    given, known = library.facts.relations, library.facts.known_factors
    texts = [relation.text for relation in given]
    texts += [_text(*place, factors) for place, factors in known.items()]

    def held(values: Mapping[str, float]) -> Constraint:
        own = [
            Relation(((1.0, *place),), values.get(": ".join(place), 0.0), _text(*place, factors))
            for place, factors in known.items()
        ]
        return constraint(library, structure, [*given, *own])

    by_name = {": ".join(place): factors for place, factors in known.items()}
    found = LawConstraint(*_constrain_by_point(held, by_name, parameters), tuple(texts))
    if texts and not len(found.common.free):
        raise ValueError(f"a law needs a free coefficient: {texts} leave none; drop one of them")
    return found


def constrain_roles(
    library: Library,
    states: Sequence[str],
    processes: Sequence[Process],
    roles: Roles,
    *,
    parameters: Sequence[str],
) -> LawConstraint:
    """What the processes of one structure ask of the coefficients at every operating point.

    roles: with the inflows that are known, as numbers or by functions of the point.
    Raises ValueError for functions that are not of the parameters, or if the coefficients do not
    tell the processes apart.
    """

    def held(values: Mapping[str, float]) -> Constraint:
        inflow = {state: values.get(f"{state} in", 0.0) for state in roles.by_point}
        own = replace(roles, inflow={**roles.inflow, **inflow})
        found = constraint_of(library, states, processes, own.known_processes)
        if found is None:
            raise ValueError(f"the coefficients do not tell these roles apart: {roles}")
        return found

    by_name = {f"{state} in": factors for state, factors in roles.by_point.items()}
    texts = tuple(_text(state, "1", factors) for state, factors in roles.by_point.items())
    by_point = _constrain_by_point(held, by_name, parameters)
    return LawConstraint(*by_point, texts, roles.by_point)


def _constrain_by_point(
    held: Callable[[Mapping[str, float]], Constraint],
    known: Mapping[str, Mapping[str, float]],
    parameters: Sequence[str],
) -> tuple[Constraint, Library, Float[np.ndarray, "coefs functions"]]:
    """What a `LawConstraint` holds of what is known by functions of the point.

    known: name -> function -> factor. held: the relations at given values of what is known, zero if
    absent. These enter every coefficient linearly, so one function is taken at a time.
    """
    functions = named_terms(list(parameters), ["1"])
    base = held({})
    columns = {"1": base.d}
    for name, factors in known.items():
        own = functions_of_point(parameters, name, factors)
        functions = functions + own
        for function, factor in zip(own.names, factors.values(), strict=True):
            more = held({name: factor}).d - base.d
            columns[function] = columns.get(function, 0.0) + more
    D = np.column_stack([columns[function] for function in functions.names])
    return replace(base, d=np.zeros(len(base.d))), functions, D


def _supplied(process: Process, inflow: Mapping[str, float]) -> Process:
    """A known process with what is supplied at a point, if it is one of these inflows."""
    state = process.role.removesuffix(IN)
    return replace(process, value=inflow[state]) if state in inflow else process


def _text(state: str, term: str, factors: Mapping[str, float]) -> str:
    """`n_n: 1 == 4.6e+22 * mdot_mg_s`, each number in its shortest exact form."""
    addends = [repr(v) if name == "1" else f"{v!r} * {name}" for name, v in factors.items()]
    return f"{state}: {term} == {' + '.join(addends)}"
