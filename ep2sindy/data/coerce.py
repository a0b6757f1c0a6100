"""Checks of the trajectories that come in.

They look for samples outside the domain of a library's functions, for states that repeat
another state, and for samples that two runs share. A `Task` is what a method is asked: trajectories
that agree, a library, and what is known of the equations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float

from ep2sindy.data.numbers import check_nonnegative
from ep2sindy.data.runs import trajectories_of
from ep2sindy.data.trajectory import Trajectory, check_agreement, read_only_mapping
from ep2sindy.library.library import Library
from ep2sindy.library.names import check_state
from ep2sindy.library.relations import Relation, complete, relations_of
from ep2sindy.library.roles import Roles
from ep2sindy.runtime.values import check_kind, check_list

# Check that the functions of a library are defined along the trajectories.


BEYOND = 5.0  # standard deviations of noise by which a sample may lie outside a domain
NOISY = 1e-9  # share of a signal's range that counts as noise, and not as rounding


def check_domain(runs: Sequence[Trajectory], library: Library, *, smooth: bool) -> None:
    """Raise ValueError naming the first sample at which a function of the library has no value.

    A run must stay in one interval of a function's domain, such as one side of a pole. smooth: the
    functions are taken of smoothed or estimated states, so that a sample may lie outside by noise.
    """
    for function in library.functions:
        for k, run in enumerate(runs):
            x = run.columns([function.variable])[:, 0]
            noise = _noise_std(x) if smooth else 0.0
            inside = function.keep_inside(x, noise)
            wrong = function.misplaced(inside, inside) | (np.abs(inside - x) > BEYOND * noise)
            if not wrong.any():
                continue
            first = int(np.argmax(wrong))
            label = f" of {run.label!r}" if run.label else f" of run {k}" if len(runs) > 1 else ""
            others = f" ({wrong.sum()} such samples)" if wrong.sum() > 1 else ""
            raise ValueError(
                f"{function.name} needs {function.need}: {function.variable}[{first}] = "
                f"{x[first]:.6g} at t = {run.t[first]:.6g} s{label}{others}; name functions of the "
                "variables that allow it, as 'log(y)', shift it, as 'log(1+y)', or crop the data"
            )


def noise_inside(
    library: Library, samples: Float[np.ndarray, "samples variables"]
) -> Float[np.ndarray, "samples variables"]:
    """The samples of a run; those that noise moved out of a function's domain lie in it again.

    They are as far from its end as the noise is large: nearer, samples tell no difference.
    """
    kept = samples.copy()
    for function in library.functions:
        x = samples[:, library.variables.index(function.variable)]
        inside = function.keep_inside(x, _noise_std(x))
        wrong = function.misplaced(x, inside)
        kept[wrong, library.variables.index(function.variable)] = inside[wrong]
    return kept


def _noise_std(x: Float[np.ndarray, " samples"]) -> float:
    """Standard deviation of a signal's white noise, by its third differences, or zero.

    They remove what is smooth, and have 20 times the variance; of a few outliers their median
    knows nothing.
    """
    if len(x) < 4:
        return 0.0
    std = float(np.median(np.abs(np.diff(x, n=3)))) / (0.6745 * np.sqrt(20.0))
    return std if std > NOISY * np.ptp(x) else 0.0


def keep_inside(
    library: Library,
    moved: Float[np.ndarray, "samples variables"],
    samples: Float[np.ndarray, "samples variables"],
) -> Float[np.ndarray, "samples variables"]:
    """Return `moved`, with the samples put back where a function of the library is undefined.

    moved: modified samples, such as smoothed ones. A value that leaves a function's domain is
    replaced by the one in `samples`. Columns: first the library's variables, then any others.
    """
    kept = moved
    for function in library.functions:
        v = library.variables.index(function.variable)
        wrong = function.misplaced(moved[:, v], samples[:, v])
        if wrong.any():
            kept = kept.copy() if kept is moved else kept
            kept[wrong, v] = samples[wrong, v]
    return kept


# Repeated data: a state that is a copy of another one, and samples that two runs share.


SAME = 1e-12  # residual of an exact copy due to rounding, as a fraction of the state's variance
MIN_SHARED = 8  # consecutive samples; shorter matches of rounded samples can occur by chance


def check_repeats(runs: Sequence[Trajectory], *, tied: bool = False) -> None:
    """Raise ValueError for repeated states or samples.

    A state that equals another one up to scale and offset makes the coefficients arbitrary, unless
    they are tied: two species of a closed reaction have a constant sum. Runs that share samples
    make the confidence intervals too small.
    """
    if not tied:
        _check_states(runs)
    begin = np.array([run.states[0, 0] for run in runs])
    for i, run in enumerate(runs):
        for start in np.flatnonzero(np.isin(run.states[:, 0], np.delete(begin, i))).tolist():
            for j in np.flatnonzero(begin == run.states[start, 0]).tolist():
                if j == i or not (shared := _common_start(run.states[start:], runs[j].states)):
                    continue
                names = [runs[k].label or f"run {k}" for k in (i, j)]
                raise ValueError(
                    f"every sample must come once: {shared} samples in a row stand in {names[0]!r} "
                    f"and in {names[1]!r}, which would make intervals too small; leave one run "
                    "out, or cut what they share"
                )


def _check_states(runs: Sequence[Trajectory]) -> None:
    names = runs[0].state_names
    if any(run.state_names != names for run in runs):
        return  # `check_agreement` reports this
    states = np.concatenate([run.states for run in runs])
    unit = (states - states.mean(axis=0)) / states.std(axis=0)
    alike = unit.T @ unit / len(unit)
    for i, j in combinations(range(len(names)), 2):
        sign = 1.0 if alike[i, j] > 0.0 else -1.0
        # Near 1 the correlation has lost half its digits, so the residual of the fit decides.
        if abs(alike[i, j]) < 0.999 or np.square(unit[:, j] - sign * unit[:, i]).mean() > SAME:
            continue
        factor = sign * states[:, j].std() / states[:, i].std()
        offset = states[:, j].mean() - factor * states[:, i].mean()
        shift = "" if abs(offset) < 1e-6 * states[:, j].std() else f" {offset:+.6g}"
        raise ValueError(
            f"states must differ: {names[j]} is {factor:.6g} {names[i]}{shift} at every sample, "
            f"and no data tell which of them a term holds; leave {names[j]} out"
        )


def _common_start(first: Float[np.ndarray, "n d"], second: Float[np.ndarray, "m d"]) -> int:
    """Number of shared samples if the shorter array is the beginning of the longer one, else 0."""
    n = min(len(first), len(second))
    same = n >= MIN_SHARED and np.array_equal(first[:MIN_SHARED], second[:MIN_SHARED])
    return n if same and np.array_equal(first[:n], second[:n]) else 0


# What a method is asked.


@dataclass(frozen=True, eq=False)
class Task:
    """What a method is asked: equations of these runs, from this library, with what is known.

    runs: trajectories of the same states, which agree in the units of the library's variables.
    relations: between coefficients. terms: for each state whose equation is known but for its
    coefficients, all terms of that equation; it is not searched. roles: of terms, for equations
    that conserve what states exchange. hidden: states that nobody measured. exclude: for each state
    that is named, terms of the library that its equation may not have.
    Raises ValueError for runs that do not agree or that share samples, a state that repeats
    another, a variable that a run lacks, a relation, term or role of unknown names, roles beside
    relations, terms, exclude or hidden states, states that are negative where roles say that they
    are not, or a term that is excluded and named elsewhere.
    """

    runs: Sequence[Trajectory]
    library: Library
    relations: Sequence[Relation] = ()
    terms: Mapping[str, Sequence[str]] = field(default_factory=dict)
    roles: Roles | None = None
    hidden: Sequence[str] = ()
    exclude: Mapping[str, Sequence[str]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_kind("library", self.library, Library, "ep.polynomial(['x', 'y'], degree=2)")
        check_list("hidden", self.hidden)
        for name, value in {
            "runs": tuple(trajectories_of(self.runs, partial=True)),
            "relations": relations_of(self.relations),
            "terms": read_only_mapping(_names_by_state("terms", self.terms)),
            "hidden": tuple(self.hidden),
            "exclude": read_only_mapping(_names_by_state("exclude", self.exclude)),
        }.items():
            object.__setattr__(self, name, value)
        self._check_hidden()
        seen = [name for name in self.library.variables if name not in self.hidden]
        check_agreement(self.runs, seen)
        check_repeats(self.runs, tied=self.roles is not None)
        self._check_known()

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the states, one equation each; hidden ones last."""
        return (*self.runs[0].state_names, *self.hidden)

    def allowed(self, equation: str) -> Bool[np.ndarray, " terms"]:
        """Mask of the library's terms that an equation may have."""
        mask = np.ones(len(self.library), dtype=np.bool_)
        mask[[self.library.index(name) for name in self.exclude.get(equation, ())]] = False
        return mask

    def complete(
        self, equation: str, found: Sequence[Bool[np.ndarray, "_ terms"]]
    ) -> list[Bool[np.ndarray, "_ terms"]]:
        """Supports found for an equation in every draw, made consistent with what is known."""
        if equation in self.terms:
            known = np.zeros((1, len(self.library)), dtype=np.bool_)
            known[0, [self.library.index(name) for name in self.terms[equation]]] = True
            return [known] * len(found)
        if not self.relations:
            return list(found)
        return [complete(masks, self.library, equation, self.relations) for masks in found]

    def _check_hidden(self) -> None:
        for name in self.hidden:
            check_state(name)
        measured = [name for run in self.runs for name in run.names]
        if twice := [name for name in self.hidden if name in measured]:
            raise ValueError(
                f"a hidden state is one that no run has: {twice} came with samples; leave them "
                "out of hidden, or out of the runs"
            )
        if len(set(self.hidden)) < len(self.hidden):
            raise ValueError(f"hidden states must differ: {list(self.hidden)} came")

    def _check_known(self) -> None:
        """Raise ValueError for an unknown state or term, or an equation without terms."""
        if self.roles is not None:
            check_kind("roles", self.roles, Roles, "ep.Roles(exchange=[('n_n', 'n_i')])")
            if self.relations or self.terms or self.exclude:
                raise ValueError(
                    "roles say which terms the equations may have and how they are tied: "
                    "relations, terms or exclude came as well; give roles alone, or leave them out"
                )
            if self.hidden:
                raise ValueError(
                    f"roles need samples of every state: {list(self.hidden)} came as hidden; give "
                    "relations between coefficients instead, or leave roles out"
                )
            self.roles.processes(self.library, self.states)
            for state in self.roles.positive:
                check_nonnegative(state, [run.columns([state])[:, 0] for run in self.runs])
        named = [(state, term) for r in self.relations for _, state, term in r.factors]
        named += [(state, term) for state, terms in self.terms.items() for term in terms]
        for state in (*self.terms, *self.exclude, *(state for state, _ in named)):
            if state not in self.states:
                raise ValueError(f"unknown state {state!r}; there are {list(self.states)}")
        for _, term in named:
            self.library.index(term)
        if empty := [state for state, terms in self.terms.items() if not terms]:
            raise ValueError(f"an equation whose terms are given must have some: {empty} has none")
        for state in self.exclude:
            if not self.allowed(state).any():
                raise ValueError(
                    f"exclude must leave terms to every equation: all {len(self.library)} of the "
                    f"library came for {state!r}; leave some of them out of exclude"
                )
        for state, term in named:
            if not self.allowed(state)[self.library.index(term)]:
                raise ValueError(
                    f"a term is excluded, or it is named in terms and relations: {term!r} of "
                    f"{state!r} came in both; leave it out of one of them"
                )


def _names_by_state(key: str, given: object) -> dict[str, tuple[str, ...]]:
    """The terms of every state that are named. Raises ValueError for what are no lists of names."""
    example = f"{key}={{'x': ['x', 'x*y']}}"
    if not isinstance(given, Mapping):
        raise ValueError(f"{key} must be lists of terms by state, like {example}: {given!r} came")
    found = {}
    for state, names in given.items():
        check_list(f"the {key} of {state!r}", names)
        if isinstance(names, Mapping) and names:
            term, value = next(iter(names.items()))
            raise ValueError(
                f"{key} names terms, without coefficients, like {example}: {dict(names)!r} came "
                f"for {state!r}; a coefficient that is known is a relation, "
                f"relations=['{state}: {term} == {value}']"
            )
        if not isinstance(names, Sequence):
            raise ValueError(f"{key} must be a list for every state: {names!r} came for {state!r}")
        if wrong := [name for name in names if not isinstance(name, str)]:
            raise ValueError(
                f"{key} must hold names of terms, like {example}: {wrong[0]!r} came for "
                f"{state!r}; the constant term is '1'"
            )
        found[state] = tuple(names)
    return found
