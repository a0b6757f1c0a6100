"""Equations of one measured signal: preparations into states, tried in turn.

Each preparation is a way to make states of the signal, with a library in these. Hidden states,
found along with their equations, end the list if they explain the signal to its noise; models of
smoothed states are compared by forecasts from the past alone, where they were fitted. What else is
not known of a signal is found here too: its lost offset, and numbers inside functions.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from ep2sindy.data.coerce import DiscoveryProblem, FailedTryError
from ep2sindy.data.numbers import least_beside_grid
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.discover import discover
from ep2sindy.discovery.foresight import is_linear
from ep2sindy.discovery.method import AnyMethod, Regression, TrajectorySearch
from ep2sindy.discovery.result import Discovery
from ep2sindy.estimation.problem import FIRST_MAX_TERMS
from ep2sindy.forecasting.evaluation import Evaluation, evaluate
from ep2sindy.forecasting.forecast import calibrate
from ep2sindy.forecasting.skill import MODEL, forecast_skill
from ep2sindy.forecasting.state_estimation import StateEstimator, estimate_states, tune_estimator
from ep2sindy.library.library import Library, polynomial
from ep2sindy.library.names import number_text
from ep2sindy.library.relations import relations_of
from ep2sindy.model.comparison import SPIRALS
from ep2sindy.regression.searches import BestSubset
from ep2sindy.runtime.kept_pieces import Once, at_once
from ep2sindy.runtime.progress import SILENT, Progress
from ep2sindy.signals.embedding import HARMONICS, Embedded, Embedding, embed, unexplained
from ep2sindy.signals.signal import Signal, is_positive

# Error of forecasts, as a fraction of that of earlier preparations, from which a later one is
# taken; starts from which it is counted, and draws of each.
CLEARLY, N_TRIED, N_DRAWS_TRIED = 0.8, 20, 20

# Candidates of a size if no equation is known, so that there are few combinations, and of more than
# two states, which have no cycle to run on: the best of a size foresees as well as the eighth.
FEW = 2

MAX_FITTED = 3000  # samples from the end of the fitted part that a search for hidden states sees

# Samples and periods at its end on which hidden states are searched first: a law of more samples is
# one of these, too.
FIRST_PART, FIRST_PERIODS = 300, 8.0

EXPLAINED = "their equations explain the signal to its noise"

MIN_FITTED = 4.0  # periods that a fitted part must have
MIN_ASSESSED = 1.5  # periods that a held-out part must have


@dataclass(frozen=True)
class StatedFacts:
    """What is known of the equations of a signal and its states, next to what these are.

    exclude: state -> terms that its equation does not have. relations: between coefficients, as
    for `Library.relate`. rests_at_zero: whether a signal that is zero and does not change stays so:
    no equation of its derivatives then has a term that is not zero there. States and terms that one
    preparation lacks are passed over there.
    """

    exclude: Mapping[str, Sequence[str]] = field(default_factory=dict)
    relations: Sequence[str] = ()
    rests_at_zero: bool = False

    def check(self, tried: Sequence[Preparation], signal: Signal) -> None:
        """Raise ValueError for facts of states that no preparation makes of the signal."""
        names = {name for each in tried for name in each.names(signal)}
        if lost := set(self.exclude) - names:
            raise ValueError(
                f"exclude must name states that are tried, {sorted(names)}: got {sorted(lost)}"
            )
        if self.rests_at_zero and all(each.how not in ("auto", "derivative") for each in tried):
            raise ValueError(
                "rests_at_zero says something of a signal and its derivatives: add "
                "{how: derivative} to tried, or leave it out"
            )

    def add_to(self, library: Library, states: Embedded) -> Library:
        """The library of some states, with what is known of them."""
        barred = {
            state: [str(term) for term in terms if str(term) in library.names]
            for state, terms in self.exclude.items()
            if state in states.names and state not in states.known
        }
        if self.rests_at_zero and states.embedding.how == "derivative":
            with np.errstate(all="ignore"):
                at_rest = library.evaluate(np.zeros((1, len(library.variables))))[0]
            moving = [n for n, value in zip(library.names, at_rest, strict=True) if value != 0.0]
            for state in (s for s in states.names if s not in states.known):
                barred[state] = [*barred.get(state, ()), *moving]
        held = [
            relation
            for relation in relations_of(self.relations)
            if all(s in states.names and t in library.names for _, s, t in relation.factors)
        ]
        return library.exclude(barred).relate(*held)


@dataclass(frozen=True)
class Preparation:
    """A way to make states of a signal, and the library that is searched in them.

    how, n_states, harmonics: of the states, see `embed`. degree, functions, function_degree: of the
    library, see `polynomial`; a `?` in a function stands for a number that is fitted, as in
    `sign(?*v)` and `1/(?+x)`.
    """

    how: str
    n_states: int = 2
    degree: int = 3
    functions: Sequence[str] = ()
    function_degree: int = 1
    harmonics: float = HARMONICS

    def __post_init__(self) -> None:
        own = "derivative" if self.how == "auto" else self.how
        Embedding(own, self.n_states, self.harmonics)  # refuses settings that no embedding has

    def names(self, signal: Signal) -> set[str]:
        """States that it makes of a signal, or may make."""
        ways = ("rate", "derivative", "delays") if self.how == "auto" else (self.how,)
        made = (Embedding(how, self.n_states, self.harmonics).names(signal) for how in ways)
        return {name for names in made for name in names}

    def linear(self, signal: Signal) -> Preparation:
        """The same with linear equations, of a derivative: x' = x g is not linear in the states."""
        is_rate = self.how == "rate" or (self.how == "auto" and signal.is_positive)
        return replace(self, how="derivative" if is_rate else self.how, degree=1, functions=())

    def search(
        self, past: Signal, method: AnyMethod, facts: StatedFacts, *, seed: int,
        progress: Progress,
        once: Once,
    ) -> tuple[Embedded, Discovery]:  # fmt: skip
        """The states, and their equations. method: of smoothed states."""
        make = partial(embed, past, n_states=self.n_states, harmonics=self.harmonics)
        with progress.stage(None, "", f"{self.n_states} states of the signal"):
            states = make(self.how)
        run, functions = states.run, self.functions
        if any(FITTED in text for text in functions):
            smoothed = make() if states.unsmoothed else states
            off = partial(self._lack_of_fit, smoothed, method, facts)
            functions = fit_functions(functions, smoothed.run, off)
        if states.unsmoothed:
            run, method = end_of(run), by_trajectories(method)
        elif not states.known or self.n_states > 2:
            method = replace(method, depth=min(method.depth, FEW))
        library = self._library(states, functions, facts)
        search = partial(
            discover, run, library, method, hidden=states.hidden, decimate=None, seed=seed
        )
        return states, once(partial(search, progress=progress))

    def _library(self, states: Embedded, functions: Sequence[str], facts: StatedFacts) -> Library:
        return facts.add_to(states.library(self.degree, functions, self.function_degree), states)

    def _lack_of_fit(
        self, states: Embedded, method: AnyMethod, facts: StatedFacts, functions: Sequence[str]
    ) -> float:
        """What the largest candidates leave of the derivatives, the product over equations.

        Infinite for functions that cannot be used on the states.
        """
        if isinstance(method, TrajectorySearch):
            method = Regression(search=BestSubset(max_terms=method.max_terms or FIRST_MAX_TERMS))
        try:
            library = self._library(states, functions, facts)
            equations = method.search_equations(DiscoveryProblem([states.run], library), rng=0)
        except ValueError:
            return float("inf")
        fronts = [each.front for each in equations if each.front.equation not in states.known]
        return float(np.prod([min(1.0 - c.r2_train for c in f.candidates) for f in fronts]))


@dataclass(frozen=True, eq=False)
class Attempt:
    """A model in the states that one preparation made of the fitted part of a signal.

    states: as they were made. run: all of them along the fitted part, hidden ones as the model has
    them. estimator: of these. error: of the model's forecasts up to a period there, in standard
    deviations. fraction: of the next state's variance that neighbours in these states do not
    explain; NaN for hidden states, of which there is no next one.
    """

    preparation: Preparation
    states: Embedded
    found: Discovery
    run: Trajectory
    estimator: StateEstimator
    error: float
    fraction: float

    @staticmethod
    def of(
        preparation: Preparation, states: Embedded, found: Discovery, progress: Progress
    ) -> Attempt:
        past, run, fraction = states.signal, states.run, float("nan")
        with progress.stage(None, "", "forecasts where it was fitted"):
            if states.unsmoothed:
                run = estimate_states(found.model, run)
            else:
                fraction = unexplained(states)
            samples = complete_states(past, run)
            estimator = tune_estimator(found.model, samples, measured=[past.name])
            skill = forecast_skill(
                found.model, past.run, n_fitted=len(past.t) // 2, starts=N_TRIED,
                horizon_s=past.period_s, states_of=states.along, n_draws=N_DRAWS_TRIED,
                estimator=estimator,
            )  # fmt: skip
        error = float(skill.nrmse[MODEL].mean())
        return Attempt(preparation, states, found, run, estimator, error, fraction)

    @property
    def searched(self) -> list[str]:
        """States whose equations were not known."""
        known = self.states.known or (list(self.states.hidden) and [self.states.signal.name])
        return [state for state in self.found.model.states if state not in known]

    @property
    def is_damped_line(self) -> bool:
        """Whether the model is x' = v, v' = a - b x - c v, with b positive and c not negative."""
        states = self.found.model.states
        if self.states.embedding.how != "derivative" or len(states) != 2:
            return False
        x, v = states
        terms = self.found.model.terms(v)
        swings = terms.get(x, 0.0) < 0.0 and terms.get(v, 0.0) <= 0.0
        return swings and set(terms) <= {"1", x, v}

    @property
    def process_noise_std(self) -> dict[str, float]:
        """What moves every state at random over a mean step next to the model, by state, in SI."""
        process = self.estimator.noise.process.tolist()
        return dict(zip(self.found.model.states, process, strict=True))

    @property
    def noise_std(self) -> float:
        """Standard deviation of the noise in the signal, in its unit."""
        if not self.states.unsmoothed:
            return self.states.noise_std
        assert self.found.estimate is not None  # a search of trajectories has one
        return float(self.found.estimate.noise_std[0])


def try_in_turn(
    past: Signal, tried: Sequence[Preparation], method: AnyMethod, *,
    facts: StatedFacts | None = None, linear: bool | None = None,
    seed: int = 0, progress: Progress = SILENT, once: Once = at_once,
) -> list[Attempt]:  # fmt: skip
    """Find a model of a signal by each preparation that can pay.

    Hidden states end the list if their model explains the signal to its noise, and stays with it
    when it is run freely where it was fitted. They are left out otherwise, unless nothing else is
    tried. A law of all samples is one of a part of them, so a part is searched first. More than two
    states are tried only of a signal that does not repeat itself, and that no input drives: one of
    two states either repeats itself or spirals. The signal alone is tried only with inputs. Of a
    linear signal, linear equations of the first smoothed states alone are tried. method: of the
    search in smoothed states; a rule that runs models tests them by the signal. facts: of the
    equations. linear: whether the signal is (`is_linear`); None finds out. once: does each search,
    or takes it from a run that was interrupted.
    Raises FailedTryError if every try failed.
    """
    facts, linear = facts or StatedFacts(), is_linear(past) if linear is None else linear
    smoothed = [each for each in tried if each.how != "hidden"]
    if past.run.input_names:  # then they make what is more than a cycle
        tried = [each for each in tried if each.n_states <= 2] or tried
    else:
        tried = [each for each in tried if each.n_states > 1] or tried
        if past.repeats:
            tried = [each for each in tried if each.n_states == 2] or tried
        elif linear and smoothed:
            tried = [smoothed[0].linear(past)]
    method, part = assessed_by(method, past.name), end_of_periods(past)
    attempts: list[Attempt] = []
    left_out, failed = [], FailedTryError()
    for each in tried:
        search = partial(
            each.search, method=method, facts=facts, seed=seed, progress=progress, once=once
        )
        try:
            brief = each.how == "hidden" and smoothed and part is not past
            if brief and search(part)[1].lack_of_fit:
                continue
            states, found = search(past)
            if not states.unsmoothed:
                attempts.append(Attempt.of(each, states, found, progress))
            elif explains(found, past.name):
                states = replace(states, reason=EXPLAINED)
                return [Attempt.of(each, states, found, progress)]
            else:
                left_out.append((each, states, found))
        except FailedTryError as error:
            failed = error
    if not (attempts or left_out):
        raise failed
    return attempts or [Attempt.of(*left_out[-1], progress)]


def assessed_by(method: AnyMethod, signal: str) -> AnyMethod:
    """The method; models that run are assessed by the signal, of which other states are made."""
    if not isinstance(method, Regression) or method.selection.basis != "runs":
        return method
    from ep2sindy.selection.free_run import FreeRunScore  # loads torch, only for this rule

    rule = method.selection
    if not isinstance(rule, FreeRunScore) or rule.assessed is not None:
        return method
    return replace(method, selection=replace(rule, assessed=(signal,)))


def end_of_periods(past: Signal) -> Signal:
    """The last periods of a signal, on which a search for hidden states is tried first."""
    n, wanted = len(past.t), max(FIRST_PART, round(FIRST_PERIODS * past.per_period))
    return past if 2 * wanted > min(n, MAX_FITTED) else past.window(n - wanted, n)


def best_of(attempts: Sequence[Attempt]) -> Attempt:
    """The first attempt, unless a later one forecasts clearly better."""
    best = attempts[0]
    for other in attempts[1:]:
        best = other if other.error < CLEARLY * best.error else best
    return best


def explains(found: Discovery, signal: str) -> bool:
    """Whether a model explains a signal to its noise, and run freely over it stays with it.

    Nor may its cycle repel: a perturbation that grew would show in a record that keeps its
    amplitude.
    """
    assert found.estimate is not None  # a search of trajectories has one
    if found.lack_of_fit:
        return False
    (record,), (path,) = found.estimate.runs, found.estimate.paths
    free = evaluate(found.estimate.model, record, initial=path[0], assessed=[signal])
    if not free.comparison.is_similar or free.cycle is None:
        return free.comparison.is_similar
    n_periods = float(record.t[-1] - record.t[0]) / free.cycle.period_s
    return bool(free.multiplier**n_periods < SPIRALS)


def fitted_part(signal: Signal, held_out: float) -> Signal:
    """The samples before the last fraction; all of them if the record is too short for that."""
    n = len(signal.t)
    n_fitted = round((1.0 - held_out) * n)
    periods = np.array([n_fitted, n - n_fitted]) / signal.per_period
    enough = periods[0] >= MIN_FITTED and periods[1] >= MIN_ASSESSED
    return signal.window(0, n_fitted if enough else n)


def run_on_rest(
    signal: Signal, best: Attempt, *, progress: Progress = SILENT
) -> tuple[Trajectory, Evaluation]:
    """Run a model freely over the samples that were not fitted, which it also forecasts.

    The start is fitted to the samples before. If all were fitted, the whole record is compared,
    from the first of the states, and there are no forecasts. Returns the states along the whole
    record, and the evaluation.
    """
    past, estimator, states_of = best.states.signal, best.estimator, best.states.along
    run, n, n_fitted, forecasts = signal.run, len(signal.t), len(past.t), None
    known = estimator.smooth(run) if best.states.unsmoothed else states_of(run)
    whole = complete_states(signal, known)
    if n_fitted == n:
        first, start = int(np.searchsorted(signal.t, best.run.t[0])), best.run.states[0]
    else:
        estimator = calibrate(estimator, past.run, states_of=states_of, progress=progress)
        first, start = n_fitted - 1, estimator.filter(states_of(past.run)).mean
        forecasts = partial(
            forecast_skill, best.found.model, run, n_fitted=n_fitted, states_of=states_of,
            estimator=estimator, progress=progress,
        )  # fmt: skip
    rest = whole.window(first, n)
    evaluation = evaluate(best.found, rest, initial=start, assessed=[signal.name])
    return whole, replace(evaluation, forecasts=forecasts)


def complete_states(signal: Signal, known: Trajectory) -> Trajectory:
    """Samples of the signal as measured, with the other states next to it as far as they are known.

    Where a state is not known, at the beginning or beyond the fitted part, the nearest is taken;
    forecasts there make their own.
    """
    nearest = np.clip(np.searchsorted(known.t, signal.t), 0, known.n_samples - 1)
    states = known.states[nearest].copy()
    states[:, 0] = signal.x
    return replace(known, t=signal.t, states=states, inputs=signal.run.inputs)


def end_of(run: Trajectory) -> Trajectory:
    """The samples that a search for hidden states sees."""
    return run.window(max(0, run.n_samples - MAX_FITTED), run.n_samples)


def by_trajectories(method: AnyMethod) -> TrajectorySearch:
    """The search for hidden states: the method itself if it can find them."""
    return TrajectorySearch(method.max_terms if isinstance(method, TrajectorySearch) else None)


# The offset that a signal has lost.

# Means, in standard deviations, of the signals from which an offset is looked for: the search for
# the growth rate finds its way from some of them alone.
SHIFTS = (0.3, 0.0, 0.1, -0.3)


def fit_offset(
    past: Signal, degree: int, method: AnyMethod, *,
    progress: Progress = SILENT, once: Once = at_once,
) -> tuple[float, float, float]:  # fmt: skip
    """Fit the offset of a signal x, by the equations of x and of the growth rate g of x + offset.

    Returns what must be added to the signal, in its unit, and the bounds of a 95 % interval.

    x' = (x + offset) g, so the offset is the coefficient of g where that of x g is one. degree: of
    the library of x and g. once: as of `try_in_turn`.
    Raises ValueError if none of its models explains the signal to its noise, or if the signal and
    its offset are not positive.
    """
    run, names = end_of(past.run), Embedding("rate").names(past)
    mean, spread = run.states.mean(), run.states.std()
    library, (x, g) = polynomial(names, degree=degree), names
    search = partial(
        discover,
        library=library.relate(f"{x}: {x}*{g} == 1").only({x: [g, f"{x}*{g}"]}),
        method=by_trajectories(method),
        hidden=[g],
        progress=progress,
    )
    for fraction in SHIFTS:
        shift = fraction * spread - mean
        try:
            found = once(partial(search, replace(run, states=run.states + shift)))
        except FailedTryError:
            continue
        rest = found.model.terms(x).get(g, 0.0)
        if not found.lack_of_fit and is_positive(past.t, past.x + shift + rest):
            low, high = found.model.intervals(x).get(g, (rest, rest))
            return shift + rest, shift + low, shift + high
    raise ValueError(
        f"offset=fit asks for equations of {past.name} with an offset and of its growth rate that "
        "explain it to within its noise: none of this library do; write offset=NUMBER if the "
        "sensor's mean is known, or leave offset out"
    )


# Numbers inside functions, written as `?`.

FITTED = "?"  # stands for a number to be fitted

# Numbers tried, in standard deviations of the variable that they are added to, or in their inverse
# if they multiply it; then the best is refined.
SIZES = 10.0 ** np.arange(-3.0, 1.6, 0.25)
TOLERANCE = 0.01  # of the logarithm of a number
DIGITS = 4  # that are kept of it


def fit_functions(
    functions: Sequence[str], run: Trajectory, lack_of_fit: Callable[[Sequence[str]], float]
) -> list[str]:
    """The functions with every `?` replaced by the number that fits a run best.

    One after the other: earlier numbers are kept while later ones are fitted, and functions whose
    number is still unknown are left out meanwhile. lack_of_fit: how badly the best equations with
    some functions fit; infinite if these cannot be used. Raises ValueError for a function with more
    than one `?`, of no variable of the run, or none of whose numbers can be used.
    """
    known = [text for text in functions if FITTED not in text]
    for text in (each for each in functions if FITTED in each):
        fill_in = partial(_fill_in, text, unit=_unit(text, run))

        def off(log_size: float, fill_in: Callable[[float], str] = fill_in) -> float:
            return lack_of_fit([*known, fill_in(np.exp(log_size))])

        tried = np.array([off(log_size) for log_size in np.log(SIZES)])
        if not np.isfinite(tried).any():
            raise ValueError(
                f"no number in the place of {FITTED} lets {text!r} be used on these data: its "
                "argument leaves the domain; write the number yourself, or another function"
            )
        log_size = least_beside_grid(off, np.log(SIZES), tried, tolerance=TOLERANCE)
        known.append(fill_in(np.exp(log_size)))
    return known


def _unit(text: str, run: Trajectory) -> float:
    """Standard deviation of the variable that a function with one unknown number is of."""
    named = [name for name in run.names if name in re.findall(r"[\w@]+", text)]
    if text.count(FITTED) != 1 or len(named) != 1:
        raise ValueError(
            f"a function with a number to be fitted must have one {FITTED} and one variable of "
            f"{list(run.names)}, such as 'sign({FITTED}*{run.names[-1]})' or "
            f"'1/({FITTED}+{run.names[0]})', got {text!r}"
        )
    return float(run.columns(named).std())


def _fill_in(text: str, size: float, unit: float) -> str:
    """The function with a number: a factor in 1/unit, or a summand in unit."""
    is_factor = f"{FITTED}*" in text.replace(" ", "")
    number = 1.0 / (size * unit) if is_factor else size * unit
    return text.replace(FITTED, number_text(float(f"{number:.{DIGITS}g}")))
