"""Checks of the trajectories that come in.

They look for samples outside the domain of a library's functions, for states that repeat
another state, and for samples that two runs share. A `DiscoveryProblem` is what a method is asked:
trajectories that agree, and a library with what is known of the equations.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float

from ep2sindy.data.numbers import check_nonnegative, noise_of
from ep2sindy.data.runs import trajectories_of
from ep2sindy.data.trajectory import Trajectory, check_agreement
from ep2sindy.library.facts import Facts
from ep2sindy.library.library import Library
from ep2sindy.library.names import check_state
from ep2sindy.library.relations import Relation, complete
from ep2sindy.runtime.values import Columns, Samples, check_kind, check_list

# Check that the functions of a library are defined along the trajectories.


BEYOND = 5.0  # standard deviations of noise by which a sample may lie outside a domain
NOISY = 1e-9  # fraction of a signal's range that counts as noise, and not as rounding


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


def noise_inside(library: Library, samples: Columns) -> Columns:
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


def _noise_std(x: Samples) -> float:
    """Standard deviation of a signal's white noise, by its third differences; zero for rounding."""
    std = noise_of(x, 3)
    return std if std > NOISY * np.ptp(x) else 0.0


def keep_inside(library: Library, moved: Columns, samples: Columns) -> Columns:
    """Return `moved`, with the samples put back where a function of the library is undefined.

    moved: modified samples, such as smoothed ones. A value that leaves a function's domain is
    replaced by the one in `samples`. Columns: first the library's variables, then any others.
    """
    kept = moved.copy() if library.functions else moved
    for function in library.functions:
        v = library.variables.index(function.variable)
        wrong = function.misplaced(moved[:, v], samples[:, v])
        kept[wrong, v] = samples[wrong, v]
    return kept


# Repeated data: a state that is a copy of another one, and samples that two runs share.


SAME = 1e-12  # residual of an exact copy due to rounding, as a fraction of the state's variance
MIN_SHARED = 8  # consecutive samples; shorter matches of rounded samples can occur by chance


def check_repeats(runs: Sequence[Trajectory], *, coupled: bool = False) -> None:
    """Raise ValueError for repeated states or samples.

    A state that equals another one up to scale and offset makes the coefficients arbitrary, unless
    they are tied: two species of a closed reaction have a constant sum. Runs that share samples
    make the confidence intervals too small.
    """
    if not coupled:
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


# What a method is asked, and what it makes of that.


class FailedTryError(ValueError):
    """What a search made of its own results cannot be used: this try failed, others need not."""


@contextmanager
def own_result(what: str) -> Iterator[None]:
    """A value that a search makes of its own results; where its checks fail, the try failed."""
    try:
        yield
    except ValueError as error:
        raise FailedTryError(f"{what}: {error}") from error


@dataclass(frozen=True, eq=False)
class DiscoveryProblem:
    """What a method is asked: equations of these runs, from this library, with what it knows.

    runs: trajectories of the same states, which agree in the units of the library's variables.
    hidden: states that nobody measured.
    Raises ValueError for runs that do not agree or that share samples, a state that repeats
    another, a variable that a run lacks, facts of unknown states, roles next to hidden states, or
    states that are negative where roles say that they are not.
    """

    runs: Sequence[Trajectory]
    library: Library
    hidden: Sequence[str] = ()

    def __post_init__(self) -> None:
        check_kind("library", self.library, Library, "ep.polynomial(['x', 'y'], degree=2)")
        check_list("hidden", self.hidden)
        object.__setattr__(self, "runs", tuple(trajectories_of(self.runs, partial=True)))
        object.__setattr__(self, "hidden", tuple(self.hidden))
        self._check_hidden()
        seen = [name for name in self.library.variables if name not in self.hidden]
        check_agreement(self.runs, seen)
        roles = self.at_point.facts.roles
        check_repeats(self.runs, coupled=roles is not None)
        if roles is not None:
            roles.processes(self.library, self.states)
            for state in roles.positive:
                check_nonnegative(state, [run.columns([state])[:, 0] for run in self.runs])
        for state in (*self.facts.excluded, *(state for state, _ in self.facts.places)):
            if state not in self.states:
                raise ValueError(f"unknown state {state!r}; there are {list(self.states)}")

    @property
    def facts(self) -> Facts:
        """What is known of the equations."""
        return self.library.facts

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the states, one equation each; hidden ones last."""
        return (*self.runs[0].state_names, *self.hidden)

    @property
    def made(self) -> set[str]:
        """The states that were made of others, whose known equations define them."""
        return self.facts.made & {*self.states}

    @property
    def at_point(self) -> Library:
        """The library with what is known at the operating point of the first run."""
        return self.library.at_operating_point(self.runs[0].parameters)

    @property
    def relations(self) -> Sequence[Relation]:
        """Between coefficients, at the operating point of the first run."""
        return self.at_point.facts.relations

    @property
    def theta(self) -> Float[np.ndarray, "samples terms"]:
        """The terms of the library at the samples of all runs."""
        variables = self.library.variables
        values = [noise_inside(self.library, run.columns(variables)) for run in self.runs]
        return self.library.evaluate(np.concatenate(values))

    def complete(
        self, equation: str, found: Sequence[Bool[np.ndarray, "_ terms"]]
    ) -> list[Bool[np.ndarray, "_ terms"]]:
        """Supports found for an equation in every draw, made consistent with what is known."""
        facts, library = self.facts, self.library
        if equation in facts.only:
            known = np.zeros((1, len(library)), dtype=np.bool_)
            known[0, [library.index(name) for name in facts.only[equation]]] = True
            return [known] * len(found)
        # At another point a coefficient may be another number than zero: its term is in.
        ones = [Relation(((1.0, *place),), 1.0, "") for place in facts.known_factors]
        relations = [*facts.relations, *ones]
        return [complete(masks, library, equation, relations) for masks in found]

    def _check_hidden(self) -> None:
        for name in self.hidden:
            check_state(name)
        measured = {name for run in self.runs for name in run.names}
        if twice := [name for name, n in Counter([*measured, *self.hidden]).items() if n > 1]:
            raise ValueError(
                f"a hidden state is one that no run has, got {twice} with samples or twice; leave "
                "them out of hidden, or out of the runs"
            )
        if self.hidden and self.facts.roles is not None:
            raise ValueError(
                f"roles need samples of every state, got {list(self.hidden)} as hidden; give "
                "relations between coefficients instead, or leave roles out"
            )
