"""Hidden states: nobody measured them, and their equations are found along with the others'.

A hidden state shows only in the rates of others, so its scale is free to choose. It is fixed by its
coupling: a term with which it enters the equation of another state, and that term's coefficient.
`x' = v` makes v the derivative of x, `x' = x*g` makes g its growth rate. Couplings lead to
different equations, so all that a library allows are tried, and the one of least -2 log likelihood
plus penalties is taken: the samples of a hidden state are missing ones (`likelihood`), and only its
guess, from the rates of the states before it, differs between couplings. Assumed is that it moves
measured states within the record.
Source: Takens 1981, doi:10.1007/BFb0091924, for why one state can show the others.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, product

import numpy as np
from jaxtyping import Bool, Float
from scipy.interpolate import make_interp_spline

from ep2sindy.data.coerce import DiscoveryProblem, FailedTryError, check_domain, own_result
from ep2sindy.data.numbers import least_squares
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import Library
from ep2sindy.library.relations import Relation, parse_relation
from ep2sindy.library.units import unit_product
from ep2sindy.model.model import SparseModel
from ep2sindy.signals.signal import is_positive
from ep2sindy.signals.smoothers import KalmanSmoother
from ep2sindy.signals.spectrum import Samples, signal_memory_s

# Fraction of a factor's mean square that weighs a hidden state's mean against what its rate tells:
# where the factor is small, this is little.
LEAST_FACTOR = 0.03

# Noise, in standard deviations of a signal, from which a smoother is suspected to take it for that.
DROWNED = 0.5

Columns = dict[str, Samples]
Terms = Bool[np.ndarray, " terms"]


@dataclass(frozen=True)
class Coupling:
    """A term by which a hidden state enters the equation of another state.

    coefficient: of the term, in SI; it fixes the scale of the hidden state. given: True if a
    relation of the user says so.
    """

    hidden: str
    state: str
    term: str
    coefficient: float = 1.0
    given: bool = False

    @property
    def relation(self) -> Relation:
        return parse_relation(f"{self.state}: {self.term} == {self.coefficient!r}")

    @property
    def words(self) -> str:
        """Sentence on how the scale of the hidden state is fixed."""
        return (
            f"{self.hidden} was not measured: its scale is such that {self.state}' has the term "
            f"{self.term} with a coefficient of {self.coefficient:g}"
        )


def couplings(
    library: Library, measured: Sequence[str], hidden: Sequence[str]
) -> list[tuple[Coupling, ...]]:
    """All ways in which hidden states may enter, one coupling for each of them.

    A hidden state enters the equation of a state before it, alone or times one of these. The first
    one of a single measured state is its rate or its growth rate, and the next one enters the
    equation of that. A relation that fixes the coefficient of such a term leaves no choice.
    Raises ValueError if there is no term for a hidden state.
    """
    choices, before, relations = [], list(measured), library.facts.relations
    for name in hidden:
        own = np.zeros(len(library), dtype=np.bool_)
        if name in library.variables:
            own = _linear_in(library, name, before)
        shown = before[1:] if len(measured) == 1 and len(before) > 1 else before
        offered = [
            Coupling(name, state, library.names[k])
            for state in shown
            for k in np.flatnonzero(own & (library.degrees <= 2)).tolist()
            if library.allowed(state)[k]
        ]
        given = [e for r in relations if (e := _fixed_by(r, name, library, own, before))]
        if not (given or offered):
            raise ValueError(
                f"a hidden state must have a term in the library, alone or times one of {before}, "
                f"that is not excluded: {name!r} has none in {list(library.names)}; add one, or "
                "leave the state out"
            )
        choices.append(given[:1] or offered)
        before.append(name)
    return list(product(*choices))


def with_guesses(
    task: DiscoveryProblem,
) -> Iterator[list[tuple[DiscoveryProblem, tuple[Coupling, ...]]]]:
    """Tasks without hidden states, one for every way in: guesses stand among the samples.

    They come in groups, the most natural first; the next group counts if no way of it fits. Ways
    without a guess that the library can be evaluated at are left out. A
    single measured state that is positive has a growth rate, whose equation keeps it positive; one
    that takes either sign has a rate, for no growth rate would let it through zero.
    """
    measured = task.runs[0].state_names
    found = couplings(task.library, measured, task.hidden)
    groups = [list(ways) for _, ways in groupby(found, key=lambda ways: ways[0])]
    if len(measured) > 1:
        groups = [found]
    elif all(is_positive(run.t, run.states[:, 0]) for run in task.runs):
        groups = sorted(groups, key=lambda ways: ways[0][0].term == task.hidden[0])
    else:
        groups = [ways for ways in groups if ways[0][0].term == task.hidden[0]] or groups
    failed, any_guess = FailedTryError(), False
    for group in groups:
        tasks = []
        for ways in group:
            try:
                tasks.append((_insert_guesses(task, ways), ways))
            except FailedTryError as error:
                failed = error
        if tasks:
            any_guess = True
            yield tasks
    if not any_guess:
        raise failed


def _insert_guesses(task: DiscoveryProblem, ways: Sequence[Coupling]) -> DiscoveryProblem:
    """The task with guesses of its hidden states, whose scales are fixed by relations.

    The equation of a single measured state has one term, unless others of it are known.
    """
    first, *_ = ways
    library = task.library.relate(*(way.relation for way in ways if not way.given))
    if len(task.runs[0].state_names) == 1 and first.state not in task.facts.only:
        library = library.only({first.state: (first.term,)})
    with own_result("no guess of the hidden states"):
        guessed = DiscoveryProblem([with_guess(run, library, ways) for run in task.runs], library)
        check_domain(guessed.runs, library, smooth=True)
    return guessed


def with_guess(run: Trajectory, library: Library, ways: Sequence[Coupling]) -> Trajectory:
    """A run with a first guess of its hidden states.

    Each one explains what a regression on the states before it leaves of the rate that it enters.
    The rate of a single measured state is left to its hidden state as a whole.
    """
    known, rates = _smooth(run)
    whole = run.state_names[0] if len(run.state_names) == 1 else ""
    units = dict(run.units)
    for way in ways:
        unit = _unit(way, library, units, run.clock.of_values)
        rate, units = rates[way.state], units | {way.hidden: unit}
        if way.state != whole:
            terms = _evaluate(library, _linear_in(library, "", list(known)), known)
            rate = rate - terms @ least_squares(terms, rate)
        one = known | {way.hidden: np.ones(run.n_samples)}
        row = np.arange(len(library)) == library.index(way.term)
        factor = way.coefficient * _evaluate(library, row, one)[:, 0]
        _add_state(run, known, rates, way.hidden, _quotient(rate, factor))
    return _insert_states(run, known, units)


def with_guess_by(model: SparseModel, run: Trajectory, *, follow: bool = False) -> Trajectory:
    """A run with the states that it lacks, as the equations of a model tell them from its rates.

    follow: see `_smooth`.
    Raises ValueError if no equation of the known states tells one of the others alone, and
    FailedTryError if the guess cannot be used.
    """
    known, rates = _smooth(run, follow=follow)
    lacking = [name for name in model.states if name not in run.state_names]
    units = dict(run.units) | {name: model.units.get(name, "1") for name in lacking}
    while lacking:
        for name in lacking:
            if (values := _infer_state(model, name, known, rates)) is not None:
                break
        else:
            raise ValueError(
                f"states that a record lacks must show in the equations of those that it has, one "
                f"at a time: none of {lacking} does in those of {list(rates)}; measure one of them"
            )
        _add_state(run, known, rates, name, values)
        lacking.remove(name)
    return _insert_states(run, known, units)


def _infer_state(model: SparseModel, name: str, known: Columns, rates: Columns) -> Samples | None:
    """A state by the first equation of a known state that it enters; None if it enters none.

    States that are not known yet count as zero; the equation is linearised there.
    """
    variables = list(model.field.library.variables)
    none = np.zeros(len(next(iter(known.values()))))
    values = np.stack([known.get(variable, none) for variable in variables], axis=1)
    slopes = model.field.jacobian(values)[:, :, variables.index(name)]
    rest = model.field.rates(values)
    for k, state in enumerate(model.states):
        if state in rates and slopes[:, k].any():
            return _quotient(rates[state] - rest[:, k], slopes[:, k])
    return None


def _smooth(run: Trajectory, *, follow: bool = False) -> tuple[Columns, Columns]:
    """Smoothed states and the inputs, by name, and the rates of the states.

    follow: a signal that the likeliest smoother takes for noise, as it may take long records of
    pulses, is smoothed by one that must follow its spectrum.
    """
    found = KalmanSmoother().estimate(run.t, run.states)
    smoothed, rates = found.smoothed.copy(), found.derivative.copy()
    if follow:
        for k in np.flatnonzero(found.noise_std > DROWNED * run.states.std(axis=0)).tolist():
            x = run.states[:, [k]]
            own = KalmanSmoother(coarsest_s=signal_memory_s(run.t, x[:, 0])).estimate(run.t, x)
            smoothed[:, k], rates[:, k] = own.smoothed[:, 0], own.derivative[:, 0]
    known = dict(zip(run.state_names, smoothed.T, strict=True))
    inputs = dict(zip(run.input_names, run.inputs.T, strict=True))
    return known | inputs, dict(zip(run.state_names, rates.T, strict=True))


def _add_state(
    run: Trajectory, known: Columns, rates: Columns, name: str, values: np.ndarray
) -> None:
    """Add one state to those that are known, and its rate to theirs."""
    known[name], rates[name] = values, make_interp_spline(run.t, values, k=3).derivative()(run.t)


def _quotient(rate: Samples, factor: Samples) -> Samples:
    """Their quotient, drawn to its mean where the factor is small."""
    square = np.square(factor)
    least, mean = LEAST_FACTOR * square.mean(), (rate @ factor) / square.sum()
    return (rate * factor + least * mean) / (square + least)


def _insert_states(run: Trajectory, known: Columns, units: Mapping[str, str]) -> Trajectory:
    """The run with more states; those that were measured as they were."""
    more = [name for name in known if name not in run.names]
    with own_result(f"no guess of {', '.join(more)}"):
        return replace(
            run,
            states=np.column_stack([run.states, *(known[name] for name in more)]),
            state_names=(*run.state_names, *more),
            units=units,
        )


def _linear_in(library: Library, name: str, others: Sequence[str]) -> Terms:
    """Terms that are this variable times others alone; for no name, terms of the others."""
    of = np.array([*library.variables, *(function.variable for function in library.functions)])
    found = ~library.exponents[:, ~np.isin(of, [name, *others])].any(axis=1)
    if name:  # itself and not within a function
        own = library.exponents[:, of == name]
        found &= (own[:, 0] == 1) & (own.sum(axis=1) == 1)
    return np.asarray(found)


def _evaluate(library: Library, rows: Terms, known: Columns) -> Float[np.ndarray, "samples rows"]:
    own = library.take(rows).over(list(known))
    return own.evaluate(np.stack(list(known.values()), axis=1))


def _fixed_by(
    relation: Relation, hidden: str, library: Library, own: Terms, before: Sequence[str]
) -> Coupling | None:
    """The coupling whose coefficient a relation fixes; None if it fixes none."""
    if len(relation.factors) != 1 or not relation.value:
        return None
    factor, state, term = relation.factors[0]
    if state not in before or not own[library.index(term)]:
        return None
    return Coupling(hidden, state, term, relation.value / factor, given=True)


def _unit(way: Coupling, library: Library, units: Mapping[str, str], time: str) -> str:
    """Unit of a hidden state whose term has a coefficient without unit. time: that of time."""
    factor = library.terms[library.index(way.term)].unit({**units, way.hidden: "1"})
    return unit_product([(units[way.state], 1), (time, -1), (factor, -1)])
