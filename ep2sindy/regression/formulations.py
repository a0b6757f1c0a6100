"""Formulations: how trajectories become rows, in differential form or in weak form.

In the weak form, integrals against test functions are regressed, so that no noise is
differentiated. `WeightedWeak` whitens these rows under the whole library. Inputs that are known
exactly, because they were set and not measured, are treated as free of noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int

from ep2sindy.data.coerce import check_domain, keep_inside, noise_inside
from ep2sindy.data.trajectory import Trajectory, check_agreement
from ep2sindy.library.library import Library
from ep2sindy.model.inputs import plausible_courses
from ep2sindy.regression.ambiguity import usable_terms
from ep2sindy.regression.least_squares import LeastSquares
from ep2sindy.regression.rows import MOST_ROWS, NoisyRows, RegressionRows, TermsAt
from ep2sindy.regression.whitening import whiten_rows
from ep2sindy.regression.windows import Boxes, Bumps, WindowFunctions, Windows
from ep2sindy.runtime.values import check_kind, check_list, locked, set_counts
from ep2sindy.signals.smoothers import KalmanEstimate, KalmanSmoother, SavitzkyGolay, Smoother


@runtime_checkable
class Split(Protocol):
    """Interface that chooses the held-out groups of one trajectory; groups are in time order."""

    def held_out(self, n_groups: int, rng: np.random.Generator) -> Bool[np.ndarray, " groups"]: ...


@dataclass(frozen=True)
class RandomSplit:
    """Hold out a random fraction of the groups of each trajectory, as in the thesis.

    Parameters
    ----------
    test_fraction : float, default 0.25
        Fraction that is held out.

    Raises
    ------
    ValueError
        If the fraction is out of range.
    """

    test_fraction: float = 0.25

    def __post_init__(self) -> None:
        _check_fraction(self.test_fraction)

    def held_out(self, n_groups: int, rng: np.random.Generator) -> Bool[np.ndarray, " groups"]:
        return BlockSplit(self.test_fraction, max(n_groups, 1)).held_out(n_groups, rng)


@dataclass(frozen=True)
class BlockSplit:
    """Hold out contiguous blocks of each trajectory.

    Neighbours in a time series are correlated, so randomly held-out rows would resemble training
    rows.

    Parameters
    ----------
    test_fraction : float, default 0.25
        Fraction that is held out.
    n_blocks : int, default 20
        Number of blocks into which a trajectory is cut.

    Raises
    ------
    ValueError
        If the fraction is out of range, or there is no block.
    """

    test_fraction: float = 0.25
    n_blocks: int = 20

    def __post_init__(self) -> None:
        _check_fraction(self.test_fraction)
        set_counts(self, {"n_blocks": 1})

    def held_out(self, n_groups: int, rng: np.random.Generator) -> Bool[np.ndarray, " groups"]:
        n_blocks = min(self.n_blocks, n_groups)
        chosen = rng.permutation(n_blocks)[: round(self.test_fraction * n_blocks)]
        return np.isin(np.arange(n_groups) * n_blocks // max(n_groups, 1), chosen)


def _check_fraction(fraction: float) -> None:
    if not 0.0 <= fraction < 1.0:
        raise ValueError(f"test_fraction must lie in [0, 1), got {fraction}")


@dataclass(frozen=True)
class Differential:
    """Regress the derivative at every sample on the library at that sample.

    It is the simplest formulation, for samples with little noise. The derivative comes from the
    smoother.

    Parameters
    ----------
    smoother : Smoother, default SavitzkyGolay()
        What smooths the samples and differentiates them.
    smooth_library : bool, default True
        True evaluates the terms on smoothed samples, False on raw ones, as in the thesis. With
        noise in the terms a wrong support can score best.
    split : Split, default RandomSplit()
        Which samples are held out to test the candidates.

    Raises
    ------
    ValueError
        If the smoother or the split is none.

    Notes
    -----
    The row of sample k in the regression of one state is

        x'(t_k) = sum_j c_j theta_j(x(t_k), u(t_k))

    and the search minimises |x' - Theta c|^2 over all training rows. Assumes that the error of the
    derivative is independent from row to row, which smoothing violates.

    Source: Brunton, Proctor & Kutz 2016, doi:10.1073/pnas.1517384113; the thesis, II.

    Examples
    --------
    >>> run = ep.lotka_volterra().trajectory()
    >>> method = ep.Regression(ep.Differential(), ep.AdaptiveLasso(), ep.Knee())
    >>> list(ep.discover(run, method=method).model.terms("x"))
    ['x', 'x*y']
    """

    smoother: Smoother = field(default_factory=SavitzkyGolay)
    smooth_library: bool = True
    split: Split = field(default_factory=RandomSplit)

    def __post_init__(self) -> None:
        check_kind("smoother", self.smoother, Smoother, "ep.signals.SavitzkyGolay()")
        check_kind("split", self.split, Split, "ep.regression.RandomSplit()")

    def assemble(
        self, trajectories: Sequence[Trajectory], library: Library, *, rng: np.random.Generator
    ) -> tuple[RegressionRows, ...]:
        """Stack the rows of all trajectories; every row uses samples of one segment without a gap.

        All equations share their rows, so there is one regression.
        Raises ValueError for no trajectory, trajectories with different states, or a variable of
        the library that a trajectory lacks.
        """
        check_agreement(trajectories, library.variables)
        check_domain(trajectories, library, smooth=self.smooth_library)
        pieces = [piece for run in trajectories for piece in run.segments()]
        n_samples = [run.n_samples for run in pieces]
        values = np.empty((sum(n_samples), len(library.variables)))
        target = np.empty((len(values), len(trajectories[0].state_names)))
        ends = np.cumsum(n_samples)
        for run, end in zip(pieces, ends.tolist(), strict=True):
            rows = slice(end - run.n_samples, end)
            self._fill(run, library, values[rows], target[rows])
        terms = TermsAt(library, values)
        problem = RegressionRows(
            theta=terms if len(values) > MOST_ROWS else terms[:],
            target=locked(target),
            library=library,
            equations=trajectories[0].state_names,
            groups=np.arange(len(values)),
            test=np.concatenate([self.split.held_out(n, rng) for n in n_samples]),
            trajectories=tuple(trajectories),
        )
        return (problem,)

    def _fill(
        self,
        run: Trajectory,
        library: Library,
        values: Float[np.ndarray, "samples variables"],
        target: Float[np.ndarray, "samples n_states"],
    ) -> None:
        """Write the library's variables and the derivatives of one trajectory at its samples."""
        n_columns = 1 if run.n_samples > MOST_ROWS else len(run.names)  # at once: each is copied
        values[:] = run.columns(library.variables)
        for k in range(0, target.shape[1], n_columns):
            some = slice(k, k + n_columns)
            target[:, some] = self.smoother.derivative(run.t, run.states[:, some])
        if not self.smooth_library:
            return
        for k in range(0, values.shape[1], n_columns):
            some = slice(k, k + n_columns)
            values[:, some] = self.smoother.smooth(run.t, values[:, some])
        if library.functions:
            raw = noise_inside(library, run.columns(library.variables))
            values[:] = keep_inside(library, values, raw)


MAX_SEGMENTS = 20  # segments of a trajectory at most; each is held out or resampled as a whole


@dataclass(frozen=True)
class Weak:
    """Regress mean derivatives over windows on mean library terms over the same windows.

    No sample is differentiated: the derivative moves to known test functions by integration by
    parts. The left-hand side always comes from the raw samples.

    Parameters
    ----------
    test_functions : WindowFunctions, default Bumps()
        `Bumps`, with a separate width for every state, or `Boxes`, as in the thesis.
    smoother : Smoother, default KalmanSmoother()
        What smooths the samples on which the terms are evaluated.
    smooth_library : bool, default True
        True evaluates the terms on smoothed samples, False on raw ones.
    split : Split, default RandomSplit()
        Which segments of time are held out, each at least two windows long if there is room. A
        window that reaches into both kinds of segments is dropped, so that no training row shares a
        sample with a held-out one.
    errors_in_variables : bool, default True
        True propagates the noise of the samples to the rows, so that criteria and the final fit can
        weight them by their covariance (`regression.whitening`). For `Bumps` only: `Boxes` may
        outnumber the samples, and then depend on each other.
    exact_inputs : sequence of str, optional
        Inputs without noise, which are neither smoothed nor corrected. None takes inputs that are
        switched, held or constant, or whose noise is below 0.1 % of their standard deviation.

    Raises
    ------
    ValueError
        If a setting is of the wrong kind, or errors_in_variables is set with `Boxes`.

    Notes
    -----
    The row of window k, with its test function phi_k, is

        -integral phi_k' x dt = sum_j c_j integral phi_k theta_j(x, u) dt

    divided by the integral of phi_k, and the search minimises the squared difference of both sides
    over all training rows.

    Source: Messenger & Bortz 2021, doi:10.1137/20M1343166; the thesis, Eqs. 10 and 11, for boxes.

    Examples
    --------
    >>> run = ep.lotka_volterra().trajectory(noise=0.02, rng=0)
    >>> found = ep.discover(run, method=ep.Regression(ep.Weak()))
    >>> found.model.terms("x")
    {'x': 0.66..., 'x*y': -0.99...}
    """

    test_functions: WindowFunctions = field(default_factory=Bumps)
    smoother: Smoother = field(default_factory=KalmanSmoother)
    smooth_library: bool = True
    split: Split = field(default_factory=RandomSplit)
    errors_in_variables: bool = True
    exact_inputs: Sequence[str] | None = None

    def __post_init__(self) -> None:
        check_kind("test_functions", self.test_functions, WindowFunctions, "ep.regression.Bumps()")
        check_kind("smoother", self.smoother, Smoother, "ep.signals.KalmanSmoother()")
        check_kind("split", self.split, Split, "ep.regression.RandomSplit()")
        check_list("exact_inputs", self.exact_inputs)
        if self.errors_in_variables and isinstance(self.test_functions, Boxes):
            raise ValueError(
                "errors_in_variables needs smooth test functions, got Boxes; use Bumps, or set "
                "errors_in_variables to false"
            )

    def assemble(
        self, trajectories: Sequence[Trajectory], library: Library, *, rng: np.random.Generator
    ) -> tuple[RegressionRows, ...]:
        """Assemble one regression per state, since every state has its own windows.

        Raises ValueError as `Differential.assemble` does, and for windows that do not fit.
        """
        check_agreement(trajectories, library.variables)
        check_domain(trajectories, library, smooth=self.smooth_library)
        pieces = [piece for run in trajectories for piece in run.segments()]
        runs = [self._sample(piece, library, rng) for piece in pieces]
        states = range(len(runs[0].windows))
        return tuple(self._problem(k, runs, library, trajectories) for k in states)

    def _sample(self, run: Trajectory, library: Library, rng: np.random.Generator) -> _Sampled:
        windows = [self.test_functions.windows(run.t, x, rng=rng) for x in run.states.T]
        longest = max(int((w.last - w.first).max()) + 1 for w in windows)
        n_segments = int(np.clip(run.n_samples // (2 * longest), 1, MAX_SEGMENTS))
        segment = np.arange(run.n_samples) * n_segments // run.n_samples
        names = tuple(dict.fromkeys([*library.variables, *run.state_names]))
        at_hand, estimate = self._smooth(run, names, library)
        with np.errstate(over="ignore"):  # RegressionRows names a term that is not finite
            terms = library.evaluate(at_hand[:, : len(library.variables)])
        return _Sampled(
            run=run,
            names=names,
            terms=terms,
            estimate=estimate,
            windows=windows,
            segment=segment,
            held_out=self.split.held_out(n_segments, rng)[segment],
        )

    def _smooth(
        self, run: Trajectory, names: Sequence[str], library: Library
    ) -> tuple[np.ndarray, KalmanEstimate | None]:
        """Samples for the library, and their Kalman estimate if it is needed."""
        t, values = run.t, run.columns(names)
        kalman = self.smoother if isinstance(self.smoother, KalmanSmoother) else None
        if kalman is None and self.errors_in_variables:
            kalman = KalmanSmoother()
        estimate = None if kalman is None else kalman.estimate(t, values)
        noise_std = None if estimate is None else estimate.noise_std
        exact = exact_columns(run, names, self.exact_inputs, noise_std)
        inside = noise_inside(library, values)
        if estimate is not None:
            estimate = replace(
                estimate,
                smoothed=keep_inside(library, np.where(exact, values, estimate.smoothed), inside),
                noise_std=np.where(exact, 0.0, estimate.noise_std),
            )
        if not self.smooth_library:
            return values, estimate
        if estimate is not None and kalman is self.smoother:
            return estimate.smoothed, estimate
        smooth = np.where(exact, values, self.smoother.smooth(t, values))
        return keep_inside(library, smooth, inside), estimate

    def _problem(
        self,
        state: int,
        runs: Sequence[_Sampled],
        library: Library,
        trajectories: Sequence[Trajectory],
    ) -> RegressionRows:
        name = runs[0].run.state_names[state]
        parts, segments, tests = zip(*(run.rows(state) for run in runs), strict=True)
        windows, test = Windows.joined(parts), np.concatenate(tests)
        n_before = np.cumsum([0, *(run.segment[-1] + 1 for run in runs[:-1])])
        target = windows.slope @ np.concatenate([run.run.states[:, state] for run in runs])
        noisy, names = None, runs[0].names
        if self.errors_in_variables:
            estimates = [run.estimate for run in runs if run.estimate is not None]
            stds = [np.broadcast_to(e.noise_std, e.smoothed.shape) for e in estimates]
            noisy = NoisyRows(
                windows=windows.taken(~test),
                target=target[~test],
                state=names.index(name),
                values=np.concatenate([run.run.columns(names) for run in runs]),
                smoothed=np.concatenate([estimate.smoothed for estimate in estimates]),
                noise_std=np.concatenate(stds),
            )
        return RegressionRows(
            theta=windows.mean @ np.concatenate([run.terms for run in runs]),
            target=target[:, None],
            library=library,
            equations=(name,),
            groups=np.concatenate([s + n for s, n in zip(segments, n_before, strict=True)]),
            test=test,
            trajectories=tuple(trajectories),
            noisy=noisy,
        )


@dataclass(frozen=True, eq=False)
class _Sampled:
    """Terms, windows of each state, and segments of a run of samples without gaps.

    names: the library's variables, then states that it lacks.
    segment: (samples,), number of the time segment that holds the sample. held_out: (samples,),
    true if that segment is held out.
    """

    run: Trajectory
    names: tuple[str, ...]
    terms: Float[np.ndarray, "samples terms"]
    estimate: KalmanEstimate | None
    windows: Sequence[Windows]
    segment: Int[np.ndarray, " samples"]
    held_out: Bool[np.ndarray, " samples"]

    def rows(
        self, state: int
    ) -> tuple[Windows, Int[np.ndarray, " rows"], Bool[np.ndarray, " rows"]]:
        """Windows that lie entirely in training segments, or entirely in held-out ones.

        With the segment of the middle of each, and which are held out.
        """
        windows = self.windows[state]
        first, last = windows.first, windows.last
        n_held_out = np.append(0, np.cumsum(self.held_out))
        inside = (n_held_out[last + 1] - n_held_out[first]) / (last + 1 - first)
        pure = (inside == 0.0) | (inside == 1.0)
        segment = self.segment[(first + last) // 2]
        return windows.taken(pure), segment[pure], inside[pure] == 1.0


@dataclass(frozen=True)
class WeightedWeak:
    """Weak rows weighted by the covariance of their noise under the whole library.

    They are the best rows for a search in noise. They are linearised about samples corrected with
    all terms, so that no support is favoured. The residual of a support then measures its
    likelihood, and the true support is the best of its size far more often (docs/benchmark.md).

    Parameters
    ----------
    weak : Weak, default Weak(split=RandomSplit(0.0))
        The weak rows, without held-out segments and with errors_in_variables.
    n_steps : int, default 2
        Number of steps in which the samples are corrected.

    Raises
    ------
    ValueError
        If rows are held out, which the weights do not include, or the noise is not propagated.

    Notes
    -----
    With the rows y and X of `weak` and the coefficients b of all terms,

        minimise |L^-1 (y - X b)|^2,   L L^T = C = covariance of y - X b by the noise of the samples

    Assumes that the noise of the samples is white, and the law in the library: fast dynamics that
    no term describes would be taken for noise. Rows are in the unit of the derivative, up to a
    factor.

    Source: Bortz, Messenger & Dukic 2023, doi:10.1007/s11538-023-01208-6, for the covariance.

    Examples
    --------
    >>> from ep2sindy.regression.front import fit_support
    >>> run = ep.lotka_volterra().trajectory(noise=0.01, rng=0)
    >>> library, rng = ep.polynomial(["x", "y"], degree=2), np.random.default_rng(0)
    >>> rows, _ = ep.WeightedWeak().assemble([run], library, rng=rng)
    >>> fit_support(rows, "x", ["x", "x*y"]).coef.round(2).tolist()
    [0.67, -1.0]
    """

    weak: Weak = field(default_factory=lambda: Weak(split=RandomSplit(0.0)))
    n_steps: int = 2

    def __post_init__(self) -> None:
        check_kind("weak", self.weak, Weak, "ep.Weak(split=ep.regression.RandomSplit(0.0))")
        if not self.weak.errors_in_variables:
            raise ValueError("weights need the noise: set weak.errors_in_variables to true")
        set_counts(self, {"n_steps": 0})

    def assemble(
        self, trajectories: Sequence[Trajectory], library: Library, *, rng: np.random.Generator
    ) -> tuple[RegressionRows, ...]:
        """Assemble one regression per state, as in `Weak.assemble`, with whitened rows."""
        problems = self.weak.assemble(trajectories, library, rng=rng)
        return tuple(self._weigh(problem) for problem in problems)

    def _weigh(self, problem: RegressionRows) -> RegressionRows:
        if problem.test.any():
            raise ValueError(
                "weighted rows cannot be held out: set weak.split.test_fraction to 0, or use Weak"
            )
        everything = usable_terms(problem)
        coef = np.zeros(len(problem.library))
        theta, target = problem.train_theta[:, everything], problem.scaled_target(0)
        coef[everything] = LeastSquares.of_rows(theta, target).coef
        white = whiten_rows(problem, everything, coef, n_steps=self.n_steps)
        # Whitened rows are in standard deviations; rescale to about the unit of the derivative.
        size = 1.0 / np.linalg.norm(white.target)
        return replace(
            problem,
            theta=white.theta * (problem.theta_scale * size),
            target=white.target[:, None] * (problem.target_scale * size),
            groups=np.arange(len(white.target)),
        )


# Noise below this fraction of an input's standard deviation is negligible next to that of any
# state.
NEGLIGIBLE = 1e-3

MAX_LEVELS = 8  # levels of a switched input at most; a noisy record has more, however coarse


def exact_columns(
    run: Trajectory,
    names: Sequence[str],
    declared: Sequence[str] | None,
    noise_std: Float[np.ndarray, " variables"] | None,
) -> Bool[np.ndarray, " variables"]:
    """Mask of the variables that are exact: the declared inputs, and never a state.

    declared: None takes inputs that are switched, held or constant, or have negligible noise if
    the noise was estimated.
    Raises ValueError for a declared name that is no input.
    """
    unknown = [name for name in declared or () if name not in run.input_names]
    if unknown:
        raise ValueError(
            f"exact_inputs must name inputs, got {unknown}; this trajectory has the inputs "
            f"{list(run.input_names)}"
        )
    if declared is not None:
        return np.isin(names, list(declared))
    noise = np.broadcast_to(np.inf if noise_std is None else noise_std, len(names))
    columns = run.columns(names).T
    is_exact = [
        name in run.input_names and (is_switched(x) or bool(std <= NEGLIGIBLE * x.std()))
        for name, x, std in zip(names, columns, noise, strict=True)
    ]
    return np.array(is_exact, dtype=np.bool_)


def is_switched(samples: Float[np.ndarray, " samples"]) -> bool:
    """Return true if a signal holds its value over most steps, or jumps between a few levels."""
    return plausible_courses([samples])[0] == "held" or len(np.unique(samples)) <= MAX_LEVELS
