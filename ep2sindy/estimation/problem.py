"""The estimation problem: records in scaled variables, and all coefficients a model may have."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import compress
from operator import attrgetter

import numpy as np
from jaxtyping import Bool, Float, Int

from ep2sindy.data.gaps import between_gaps, mean_step
from ep2sindy.data.numbers import zero_to_one
from ep2sindy.data.sensor import Bounds, bounds_of
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.estimation.coefficients import coefficients_of
from ep2sindy.estimation.cost import SearchMonitor
from ep2sindy.library.library import Library
from ep2sindy.library.relations import Process
from ep2sindy.model.flow import Steps, ends
from ep2sindy.model.inputs import Curve, check_courses, curve_through, plausible_courses
from ep2sindy.model.vector_field import VectorField

# Arrays by their axes: d states, and the free coefficients of a problem.
ByState = Float[np.ndarray, " d"]
StateMask = Bool[np.ndarray, " d"]
BySample = Float[np.ndarray, "samples d"]
ByCoefficient = Float[np.ndarray, " free"]
Support = Bool[np.ndarray, " free"]

MIN_SAMPLES = 5  # of a record: a smoother accepts no fewer
FIRST_MAX_TERMS = 7  # of one equation
SAMPLES_PER_TERM = 5  # of the library: fewer samples do not tell which terms are present
SAMPLES_PER_COEFFICIENT = 10  # of an equation, if samples are few: more terms would fit noise


@dataclass(frozen=True, eq=False)
class ScaledRecord:
    """A trajectory, or a segment of it between gaps, in scaled variables.

    times: (samples,), and steps: (samples - 1,), in units of the mean step. samples: (samples, d).
    inputs: at the samples, and their courses between them, see `model.inputs`. limits: between
    which the true values lie; both are the sample itself unless it was clipped or rounded. missing:
    (samples, d), true where nothing was measured, as for all of a hidden state; the samples there
    are nothing but a start. run: number of the run that it is a segment of. parts: the records of
    which this one is made, one after the other; none for most.
    """

    times: Float[np.ndarray, " samples"]
    samples: BySample
    inputs: Float[np.ndarray, "samples n_inputs"]
    courses: tuple[str, ...]
    limits: Bounds
    missing: Bool[np.ndarray, "samples d"]
    run: int = 0
    parts: tuple[ScaledRecord, ...] = ()

    @staticmethod
    def join(records: Sequence[ScaledRecord]) -> ScaledRecord:
        """All records as one, so that each pass over the samples is a single call."""

        def of_all(name: str) -> np.ndarray:
            return np.concatenate([attrgetter(name)(record) for record in records])

        return ScaledRecord(
            times=of_all("times"),
            samples=of_all("samples"),
            inputs=of_all("inputs"),
            courses=records[0].courses,
            limits=Bounds(of_all("limits.lower"), of_all("limits.upper"), ()),
            missing=of_all("missing"),
            parts=tuple(records),
        )

    @cached_property
    def breaks(self) -> Int[np.ndarray, " breaks"]:
        """Numbers of the steps between parts: no flow leads from one record to the next."""
        return np.cumsum([len(part.times) for part in self.parts], dtype=np.int64)[:-1] - 1

    @property
    def values(self) -> BySample:
        """The samples, with NaN in place of limits and of missing samples."""
        return np.where(self.limits.at | self.missing, np.nan, self.samples)

    def segments(self) -> list[ScaledRecord]:
        """The segments between gaps, which no step of the flow may cross; or all, if it has none.

        Segments of under five samples are left out. If these hold more than half of the samples,
        the long steps are the way in which the record was sampled, and no gaps.
        """
        pieces, n = between_gaps(self.times), len(self.times)
        long = [(a, b) for a, b in pieces if b - a >= MIN_SAMPLES]
        if len(pieces) == 1 or 2 * sum(b - a for a, b in long) < n:
            return [self]
        places = np.arange(n)
        inside = [(a <= places) & (places < b) for a, b in long]
        return [self.kept(each, self.samples[each]) for each in inside]

    def end(self, most: int) -> ScaledRecord:
        """The last samples, at most so many, and none from before the last gap."""
        n = len(self.times)
        kept = np.arange(n) >= max(n - most, between_gaps(self.times)[-1][0])
        return self.kept(kept, self.samples[kept])

    def kept(
        self, kept: Bool[np.ndarray, " samples"], samples: Float[np.ndarray, "kept d"]
    ) -> ScaledRecord:
        """Keep some of the samples, and replace their values; limits shift with them."""
        by, limits = samples - self.samples[kept], self.limits
        return replace(
            self,
            times=self.times[kept],
            samples=samples,
            inputs=self.inputs[kept],
            limits=replace(limits, lower=limits.lower[kept] + by, upper=limits.upper[kept] + by),
            missing=self.missing[kept],
        )

    @cached_property
    def steps(self) -> Float[np.ndarray, " steps"]:
        """Lengths of the steps; those between parts have none."""
        steps = np.diff(self.times)
        steps[self.breaks] = 0.0
        return steps

    def inputs_at(self, fraction: float) -> Float[np.ndarray, "steps n_inputs"]:
        """Inputs at a given fraction of every step."""
        rows = [(part.curve.at(fraction), part.inputs[-1:]) for part in self.parts]
        return np.concatenate([each for pair in rows for each in pair])[:-1]

    def divided(self, n_substeps: int) -> Steps:
        """The steps, each divided into equal substeps."""
        fractions = np.linspace(0.0, 1.0, 2 * n_substeps + 1)
        inputs = np.zeros((len(fractions), len(self.steps), 0))
        if self.inputs.shape[1]:
            inputs = np.array([self.inputs_at(fraction) for fraction in fractions.tolist()])
        return Steps(self.steps / n_substeps, inputs)

    @cached_property
    def curve(self) -> Curve:
        """The inputs between the samples."""
        return curve_through(self.times, self.inputs, self.courses)


@dataclass(frozen=True, eq=False)
class EstimationProblem:
    """Records, the library of their variables, and the coefficients: coef = C free + fixed.

    The problem is to find the free coefficients z, most of them zero, and the states x that make

        -2 log likelihood of the samples (`likelihood`) + sum of penalties of the terms (`supports`)

    least, in variables of unit size: states over their RMS, time over the mean step. Assumed is
    that the library holds the law. The penalties are those of the Bayesian information criterion.
    Source: Schwarz 1978, doi:10.1214/aos/1176344136; Chen & Chen 2008, doi:10.1093/biomet/asn034.

    Without relations and roles all coefficients are free: C is None, and fixed is zero. Under roles
    each process is one free coefficient.

    library: of scaled variables, states first. term_names: names of its terms in SI variables.
    equation, column: (coefficients,), the equation and the term of each coefficient.
    C: (coefficients, free), scaled. fixed_SI: (coefficients,), in SI, so that a coefficient that a
    relation fixes has its value to the last digit.
    required: (free,), coefficients that are never left out. to_SI: (coefficients,), factors from
    scaled coefficients to SI. scale: (d,), RMS of the states in SI; step_s: the unit of time.
    measured: (d,), False for hidden states. monitor: informed of every step of a fit. whole: the
    problem with all terms, if this one has only those of a working set; places: (coefficients,),
    their positions in it. most_terms: asked for of one equation. allowed_courses: of each input,
    the most plausible first. widen: makes the problem with all products of one degree more.
    processes: one for each free coefficient under roles; else none. nonnegative: (d,), states that
    never start below zero.
    """

    library: Library
    term_names: tuple[str, ...]
    states: tuple[str, ...]
    records: tuple[ScaledRecord, ...]
    equation: Int[np.ndarray, " coefficients"]
    column: Int[np.ndarray, " coefficients"]
    C: Float[np.ndarray, "coefficients free"] | None
    fixed_SI: Float[np.ndarray, " coefficients"]
    required: Support
    to_SI: Float[np.ndarray, " coefficients"]
    scale: ByState
    input_scale: Float[np.ndarray, " n_inputs"]
    step_s: float
    measured: StateMask
    places: Int[np.ndarray, " coefficients"]
    nonnegative: StateMask
    processes: tuple[Process, ...] = ()
    inputs: tuple[str, ...] = ()
    most_terms: int = FIRST_MAX_TERMS
    allowed_courses: tuple[tuple[str, ...], ...] = ()
    monitor: SearchMonitor = field(default_factory=SearchMonitor)
    whole: EstimationProblem | None = None
    widen: Callable[[], EstimationProblem] | None = None

    def restricted(self, kept: Support) -> EstimationProblem:
        """The same records with some of the coefficients; the others are zero."""
        if kept.all():
            return self
        rows = kept
        if self.C is not None:
            rows = (self.C[:, kept] != 0.0).any(axis=1) | (self.fixed_SI != 0.0)
        columns = np.unique(self.column[rows])
        return replace(
            self,
            library=self.library.take(columns),
            term_names=tuple(self.term_names[column] for column in columns),
            equation=self.equation[rows],
            column=np.searchsorted(columns, self.column[rows]),
            C=None if self.C is None else self.C[np.ix_(rows, kept)],
            fixed_SI=self.fixed_SI[rows],
            required=self.required[kept],
            to_SI=self.to_SI[rows],
            places=self.places[rows],
            processes=tuple(compress(self.processes, kept)),
            whole=self.candidates,
        )

    @property
    def candidates(self) -> EstimationProblem:
        """The problem with all terms that may be in the model."""
        return self.whole or self

    @property
    def taken(self) -> Bool[np.ndarray, " coefficients"]:
        """Mask of the candidates' coefficients that this problem has."""
        return np.isin(np.arange(len(self.candidates.column)), self.places)

    @property
    def enough_samples(self) -> bool:
        """True if there are enough samples to tell which terms of the library are present."""
        return self.n_samples >= SAMPLES_PER_TERM * len(self.candidates.library)

    @property
    def max_terms(self) -> int:
        """Most terms allowed in one equation; fewer than asked for if the samples are few."""
        if self.enough_samples:
            return self.most_terms
        return max(1, min(self.most_terms, self.n_samples // SAMPLES_PER_COEFFICIENT))

    def record(self, run: Trajectory, number: int = 0) -> ScaledRecord:
        """A run with the same states and inputs, in the scale of this problem."""
        states, missing = run.columns(self.states), np.tile(~self.measured, (run.n_samples, 1))
        if run.missing is not None:
            missing |= run.missing[:, [run.state_names.index(state) for state in self.states]]
        limits = bounds_of(states, self.states) or Bounds(states, states, ())
        return ScaledRecord(
            times=(run.t - run.t[0]) / self.step_s,
            samples=states / self.scale,
            inputs=run.columns(self.inputs) / self.input_scale,
            courses=self.courses,
            limits=Bounds(limits.lower / self.scale, limits.upper / self.scale, limits.words),
            missing=missing,
            run=number,
        )

    def of(self, runs: Sequence[Trajectory]) -> EstimationProblem:
        """The problem with the segments of these runs as its records."""
        whole = [self.record(run, number) for number, run in enumerate(runs)]
        return replace(self, records=tuple(part for each in whole for part in each.segments()))

    @cached_property
    def all_records(self) -> ScaledRecord:
        """All records as one."""
        return ScaledRecord.join(self.records)

    def split(self, values: Float[np.ndarray, "samples _"]) -> list[np.ndarray]:
        """The part of each record of what all records have, one after the other."""
        return np.split(values, self.all_records.breaks + 1)

    @property
    def courses(self) -> tuple[str, ...]:
        """The most plausible course of every input that is allowed."""
        return tuple(options[0] for options in self.allowed_courses)

    def on_courses(self, courses: tuple[str, ...]) -> EstimationProblem:
        """The same records, their inputs on these courses alone."""
        records = tuple(replace(record, courses=courses) for record in self.records)
        return replace(self, records=records, allowed_courses=tuple(zip(courses)))

    @property
    def n_samples(self) -> int:
        return sum(len(record.samples) for record in self.records)

    @cached_property
    def limited(self) -> StateMask:
        """Mask of the measured states that have limits among their samples."""
        return self.measured & self.all_records.limits.at.any(axis=0)

    @property
    def n_squares(self) -> int:
        """Measured samples of all states, about the value of the squares if a model fits."""
        return int(self.n_measured.sum())

    @cached_property
    def n_measured(self) -> Int[np.ndarray, " d"]:
        """Number of measured samples of each state."""
        return (~self.all_records.missing).sum(axis=0)

    @property
    def n_free(self) -> int:
        return len(self.column) if self.C is None else self.C.shape[1]

    @cached_property
    def positive(self) -> Support:
        """Mask of the free coefficients that must be positive."""
        found = np.zeros(self.n_free, dtype=np.bool_)
        found[: len(self.processes)] = [process.one_sign for process in self.processes]
        return found

    @cached_property
    def block(self) -> Int[np.ndarray, " free"]:
        """Equation that each free coefficient belongs to; the first one, if several share it."""
        return self.equation if self.C is None else self.equation[np.argmax(self.C != 0.0, axis=0)]

    @cached_property
    def degrees(self) -> Int[np.ndarray, " free"]:
        """Degree of each free coefficient's term; the least, if several terms share it."""
        degrees = self.library.degrees[self.column]
        if self.C is None:
            return degrees
        return np.where(self.C != 0.0, degrees[:, None], degrees.max()).min(axis=0)

    def coef(self, free: ByCoefficient) -> Float[np.ndarray, "terms d"]:
        """Scaled coefficients as a matrix."""
        coef = np.zeros((len(self.library), len(self.states)))
        scaled = free if self.C is None else self.C @ free + self.fixed_SI / self.to_SI
        coef[self.column, self.equation] = scaled
        return coef

    def coef_SI(self, free: ByCoefficient) -> Float[np.ndarray, " coefficients"]:
        """All coefficients that may differ from zero, in SI."""
        return (free if self.C is None else self.C @ free) * self.to_SI + self.fixed_SI

    def ends(
        self, states: Float[np.ndarray, "steps d"], free: np.ndarray, n_substeps: int
    ) -> Float[np.ndarray, "steps d"]:
        """States at the end of each step, by `n_substeps` classical Runge-Kutta steps."""
        return ends(self.field(free), states, self.all_records.divided(n_substeps))

    def field(self, free: ByCoefficient) -> VectorField:
        """The scaled right-hand side with these coefficients."""
        return VectorField(self.library, self.coef(free))


def scale_problem(
    runs: Sequence[Trajectory],
    library: Library,
    *,
    measured: Sequence[str] = (),
    courses: Mapping[str, str] | None = None,
    monitor: SearchMonitor | None = None,
) -> EstimationProblem:
    """Scale records and library, and collect the coefficients that may be in the model.

    measured: names of states; empty means all. Inputs that the library does not have are left out;
    the others are taken by name, in the order of the first run. courses: of inputs between their
    samples; others have all that these allow.
    Raises ValueError for an unknown input or course, or coefficients that are known functions of
    the operating point, of which there are several.
    """
    states, point = runs[0].state_names, runs[0].parameters
    if library.facts.known and any(run.parameters != point for run in runs):
        raise ValueError(
            "known coefficients differ between these operating points: estimate one after the "
            "other, or let ep.discover(runs, library, law=1) find the law of all"
        )
    inputs = [name for name in runs[0].input_names if name in library.variables]
    allowed = _allow_courses(runs, inputs, courses or {})
    names, roles = [*states, *inputs], library.facts.roles
    whole = library.at_operating_point(point).with_known_terms(states)
    over = replace(whole.over(names), facts=whole.facts)
    samples = np.concatenate([run.columns(names) for run in runs])
    size = zero_to_one(np.sqrt(np.square(samples).mean(axis=0)))
    step_s = mean_step(*(run.t for run in runs))
    scaled, numbers = over.scaled(size)
    processes = roles.processes(library, states) if roles else []
    equation, column, ties = coefficients_of(over, states, processes)
    to_SI = size[equation] / (numbers[column] * step_s)
    fixed = np.isin(equation, [states.index(state) for state in library.facts.only])
    return EstimationProblem(
        library=scaled,
        term_names=over.names,
        states=tuple(states),
        records=(),
        equation=equation,
        column=column,
        C=ties and ties.C * to_SI[ties.leads] / to_SI[:, None],
        fixed_SI=ties.fixed if ties else np.zeros(len(column)),
        required=(ties.C[fixed] != 0.0).any(axis=0) if ties else fixed,
        to_SI=to_SI,
        scale=size[: len(states)],
        input_scale=size[len(states) :],
        step_s=step_s,
        measured=np.isin(states, measured or states),
        places=np.arange(len(column)),
        nonnegative=np.isin(states, roles.positive if roles else []),
        processes=tuple(processes),
        inputs=tuple(inputs),
        allowed_courses=tuple(allowed.values()),
        monitor=monitor or SearchMonitor(),
    ).of(runs)


def _allow_courses(
    runs: Sequence[Trajectory], inputs: Sequence[str], courses: Mapping[str, str]
) -> dict[str, tuple[str, ...]]:
    """Courses of every input that its samples allow, or the one that is given."""
    given = {name: (course,) for name, course in check_courses(courses, inputs).items()}
    return {n: plausible_courses([run.columns([n]) for run in runs]) for n in inputs} | given


def by_run(
    problem: EstimationProblem, paths: Sequence[np.ndarray], runs: Sequence[Trajectory]
) -> Iterator[tuple[Trajectory, BySample]]:
    """Each run as it was fitted, and its path in SI: the segments of a run with gaps together.

    Its samples are those that were fitted, the estimated path of hidden states among them.
    """
    pairs = list(zip(problem.records, paths, strict=True))
    for number, run in enumerate(runs):
        own = [(record, path) for record, path in pairs if record.run == number]
        path = np.concatenate([path for _, path in own])
        times = np.concatenate([record.times for record, _ in own])
        kept = np.isin((run.t - run.t[0]) / problem.step_s, times)
        if not (kept.all() and problem.measured.all()):
            samples = np.concatenate([record.samples for record, _ in own])
            run = replace(
                run,
                t=run.t[kept],
                states=np.where(problem.measured, samples, path) * problem.scale,
                inputs=run.inputs[kept],
                missing=None if run.missing is None else run.missing[kept],
            )
        yield run, path * problem.scale
