"""What is found along with the equations of one signal, for nobody has measured it.

These are further states, the offset that the signal has lost, and numbers inside functions.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ep2sindy.data.numbers import least_beside_grid
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.discover import discover
from ep2sindy.discovery.method import TrajectorySearch
from ep2sindy.discovery.result import Discovery
from ep2sindy.estimation.estimate import Estimate
from ep2sindy.forecasting.evaluation import evaluate
from ep2sindy.forecasting.state_estimation import StateEstimator, tune_estimator
from ep2sindy.library.library import Library
from ep2sindy.library.names import number_text
from ep2sindy.model.comparison import SPIRALS
from ep2sindy.runtime.parallel import Once, at_once
from ep2sindy.runtime.progress import Progress
from ep2sindy.signals.embedding import Embedded
from ep2sindy.signals.trace import Trace, is_positive

MAX_FITTED = 3000  # samples from the end of the fitted part that the search sees

# Means, in standard deviations, of the signals from which an offset is looked for: the search for
# the growth rate finds its way from some of them alone.
SHIFTS = (0.3, 0.0, 0.1, -0.3)


@dataclass(frozen=True, eq=False)
class HiddenStates:
    """An embedding by a model: its states as it fits them to the samples of a signal.

    noise_std: of the signal's samples, in SI.
    """

    estimator: StateEstimator
    noise_std: float

    @property
    def n_states(self) -> int:
        return len(self.estimator.model.states)

    @property
    def says(self) -> str:
        return f"the signal and {self.n_states - 1} that nobody measured"

    def embed(self, signal: Trace) -> Embedded:
        model = self.estimator.model
        known = {signal.name: tuple(model.terms(signal.name))}  # its term sets a scale
        run = self.estimator.smooth(record_of(signal))
        return Embedded(self, run, (), known, self.noise_std)


def embed_hidden(signal: Trace, found: Discovery, reason: str) -> Embedded:
    """The states that a model with hidden ones has along a signal."""
    assert found.estimate is not None  # a search of trajectories has one
    estimator = tune_estimator(found.model, record_of(signal))
    states = HiddenStates(estimator, float(found.estimate.noise_std[0])).embed(signal)
    return replace(states, reason=reason)


def search_hidden(
    past: Trace,
    libraries: Iterable[Library],
    method: TrajectorySearch,
    progress: Progress,
    once: Once = at_once,
) -> tuple[Discovery, bool]:
    """The model of the first library that explains a signal, or of the last, and if it explains it.

    It explains the signal if it does so to its noise, and run freely stays with it where it was
    fitted. once: does each search, or takes it from a run that was broken off.
    """
    run, explains = _record_searched(past), False
    for library in libraries:
        hidden = [name for name in library.variables if name != past.name]
        found = once(partial(discover, run, library, method, hidden=hidden, progress=progress))
        assert found.estimate is not None  # a search of trajectories has one
        if explains := not found.misfit and _endures(found.estimate, past.name):
            break
    return found, explains


def fit_offset(
    past: Trace,
    library: Library,
    method: TrajectorySearch,
    progress: Progress,
    once: Once = at_once,
) -> tuple[float, float, float]:
    """The offset of a signal x, by the equations of x and of the growth rate g of x + offset.

    Returns what must be added to the signal, in its unit, and the bounds of a 95 % interval.

    x' = (x + offset) g, so the offset is the coefficient of g where that of x g is one. library: of
    x and g. once: as of `search_hidden`.
    Raises ValueError if none of its models explains the signal to its noise, or if the signal and
    its offset are not positive.
    """
    run = _record_searched(past)
    mean, spread = run.states.mean(), run.states.std()
    x, g = library.variables
    for share in SHIFTS:
        shift = share * spread - mean
        found = once(
            partial(
                discover,
                replace(run, states=run.states + shift),
                library,
                method,
                relations=[f"{x}: {x}*{g} == 1"],
                terms={x: [g, f"{x}*{g}"]},
                hidden=[g],
                progress=progress,
            )
        )
        rest = found.model.terms(x).get(g, 0.0)
        if not found.misfit and is_positive(past.t, past.x + shift + rest):
            low, high = found.model.intervals(x).get(g, (rest, rest))
            return shift + rest, shift + low, shift + high
    raise ValueError(
        f"offset=fit asks for equations of {past.name} with an offset and of its growth rate that "
        "explain it to its noise: none of this library do; write offset=NUMBER, as the sensor's "
        "mean is known, or leave it out"
    )


def _endures(estimate: Estimate, signal: str) -> bool:
    """Whether the model, run freely over the record that it was fitted to, stays with it.

    Nor may its cycle repel: a departure that grew would show in a record that keeps its amplitude.
    """
    (record,), (path,) = estimate.runs, estimate.paths
    free = evaluate(estimate.model, record, initial=path[0], judged=[signal])
    if not free.is_similar or free.cycle is None:
        return free.is_similar
    n_periods = float(record.t[-1] - record.t[0]) / free.cycle.period_s
    return free.multiplier**n_periods < SPIRALS


def record_of(signal: Trace) -> Trajectory:
    """A signal as a record of one state."""
    return Trajectory(
        signal.t,
        signal.x[:, None],
        (signal.name,),
        units={signal.name: signal.unit},
        label=signal.name,
        clock=signal.clock,
    )


def _record_searched(past: Trace) -> Trajectory:
    """The samples that the search sees, as a record of one state."""
    return record_of(past.window(max(0, len(past.t) - MAX_FITTED), len(past.t)))


# Numbers inside functions, written as `?`.

FITTED = "?"  # stands for a number to be fitted

# Numbers tried, in standard deviations of the variable that they are added to, or in their inverse
# if they multiply it; then the best is refined.
SIZES = 10.0 ** np.arange(-3.0, 1.6, 0.25)
TOLERANCE = 0.01  # of the logarithm of a number
DIGITS = 4  # that are kept of it

LibraryOf = Callable[[Sequence[str]], Library]
Misfit = Callable[[Library], float]


def fit_functions(
    functions: Sequence[str], run: Trajectory, library_of: LibraryOf, misfit: Misfit
) -> list[str]:
    """The functions with every `?` replaced by the number whose library fits a run best.

    One after the other: earlier numbers are kept while later ones are fitted, and functions whose
    number is still unknown are left out meanwhile. library_of: library with some functions. misfit:
    how badly the best equations of a library fit; infinite if they cannot be used.
    Raises ValueError for a function with more than one `?`, of no variable of the run, or none of
    whose numbers can be used.
    """
    known = [text for text in functions if FITTED not in text]
    for text in functions:
        if FITTED not in text:
            continue
        unit = _unit(text, run)

        def off(log_size: float, text: str = text, unit: float = unit) -> float:
            return misfit(library_of([*known, _fill_in(text, np.exp(log_size), unit)]))

        tried = np.array([off(log_size) for log_size in np.log(SIZES)])
        if not np.isfinite(tried).any():
            raise ValueError(
                f"no number in the place of {FITTED} lets {text!r} be used on these data: its "
                "argument leaves the domain; write the number yourself, or another function"
            )
        log_size = least_beside_grid(off, np.log(SIZES), tried, tolerance=TOLERANCE)
        known.append(_fill_in(text, np.exp(log_size), unit))
    return known


def _unit(text: str, run: Trajectory) -> float:
    """Standard deviation of the variable that a function with one unknown number is of."""
    named = [name for name in run.names if name in re.findall(r"[\w@]+", text)]
    if text.count(FITTED) != 1 or len(named) != 1:
        raise ValueError(
            f"a function with a number to be fitted must have one {FITTED} and one variable of "
            f"{list(run.names)}, such as 'sign({FITTED}*{run.names[-1]})' or "
            f"'1/({FITTED}+{run.names[0]})': {text!r} came"
        )
    return float(run.columns(named).std())


def _fill_in(text: str, size: float, unit: float) -> str:
    """The function with a number: a factor in 1/unit, or a summand in unit."""
    is_factor = f"{FITTED}*" in text.replace(" ", "")
    number = 1.0 / (size * unit) if is_factor else size * unit
    return text.replace(FITTED, number_text(float(f"{number:.{DIGITS}g}")))
