"""SparseModel: equations with few terms that can be read, integrated, scored and stored."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.special import ndtri

from ep2sindy.data.coerce import check_domain
from ep2sindy.data.runs import Run, Runs, is_run, trajectories_of, trajectory_of
from ep2sindy.library.equations import equation_text, equations_latex, sum_sympy
from ep2sindy.library.library import Library
from ep2sindy.library.units import SECONDS, Clock
from ep2sindy.model.display import model_html, model_lines
from ep2sindy.model.draws import draw_coef, draw_runs
from ep2sindy.model.inputs import check_courses, driven, inputs_at_samples
from ep2sindy.model.restarts import one_step
from ep2sindy.model.rollout import Rollout, check_start, simulate
from ep2sindy.model.scores import r2
from ep2sindy.model.storage import model_text, read_model, read_stored
from ep2sindy.model.vector_field import VectorField
from ep2sindy.runtime.files import write_text
from ep2sindy.runtime.screen import N_LINES
from ep2sindy.runtime.values import check_count, read_only

if TYPE_CHECKING:
    import sympy


@dataclass(frozen=True, eq=False)
class SparseModel:
    """Equations x' = library(states, inputs) coef, in SI units.

    A model integrates (`simulate`, `rollout`), evaluates its right-hand side (`predict`), prints,
    and is saved as JSON. Its arrays cannot be changed.

    Parameters
    ----------
    library : Library
        The terms. Facts of the equations are dropped.
    states : sequence of str
        One name per equation.
    coef : (terms, equations) array
        Coefficients in SI, zero outside the support.
    units : mapping of str to str, default {}
        Units of the states and of the library's variables. A name that is absent has the unit "1".
    provenance : mapping of str to str, default {}
        Record of how the model was found.
    covariance : (coefs, coefs) array, optional
        Covariance of the nonzero coefficients in SI, ordered by equation and within each equation
        in the order of the library. None if it is not known.
    clock : Clock, default SECONDS
        Unit of time in which the equations are displayed. Coefficients stay in SI.
    courses : mapping of str to str, default {}
        How each input goes from one sample to the next: "held" (at the value of the last one),
        "linear" or "smooth" (a cubic spline). Other inputs are held if their samples rest over most
        steps, and else smooth.

    Raises
    ------
    ValueError
        If states repeat, coefficients have another shape or are not finite, or the covariance has
        another shape.

    Notes
    -----
    The right-hand side is

        x_s' = sum_j coef[j, s] theta_j(x, u)

    Examples
    --------
    >>> library = ep.polynomial(["x", "v"], degree=1)
    >>> spring = ep.model.coef_matrix(library, [{"v": 1.0}, {"x": -4.0}])
    >>> print(ep.SparseModel(library, ["x", "v"], spring).text())
    x' = v
    v' = -4 x
    """

    library: Library
    states: Sequence[str]
    coef: Float[np.ndarray, "terms equations"]
    units: Mapping[str, str] = field(default_factory=dict)
    provenance: Mapping[str, str] = field(default_factory=dict)
    covariance: Float[np.ndarray, "_ _"] | None = None
    clock: Clock = SECONDS
    courses: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "states", tuple(self.states))
        object.__setattr__(self, "coef", read_only(self.coef))
        object.__setattr__(self, "library", self.library.plain)
        names = dict.fromkeys((*self.states, *self.library.variables))
        units = {name: self.units.get(name, "1") for name in names}
        object.__setattr__(self, "units", MappingProxyType(units))
        object.__setattr__(self, "provenance", MappingProxyType(dict(self.provenance)))
        object.__setattr__(self, "courses", check_courses(self.courses, self.inputs))
        if len(set(self.states)) < len(self.states):
            raise ValueError(f"states must be unique, got {list(self.states)}")
        if self.coef.shape != (len(self.library), len(self.states)):
            raise ValueError(
                "coef must have one row per term and one column per equation, got shape "
                f"{self.coef.shape} for {len(self.library)} terms and {list(self.states)}"
            )
        if not np.isfinite(self.coef).all():
            raise ValueError(f"coefficients must be finite, got {self.coef.tolist()}")
        if self.covariance is not None:
            object.__setattr__(self, "covariance", read_only(self.covariance))
            n_coefs = int(np.count_nonzero(self.coef))
            if self.covariance.shape != (n_coefs, n_coefs):
                raise ValueError(
                    "covariance must have a row and a column per coefficient that is not zero, got "
                    f"shape {self.covariance.shape} for {n_coefs}"
                )

    def __eq__(self, other: object) -> bool:
        """True for the same equations, from the same library, in the same units and as certain.

        Numbers are compared exactly; provenance and clock may differ.
        """
        if not isinstance(other, SparseModel):
            return NotImplemented
        mine, theirs = (
            (m.states, m.library.variables, m.library.names, m.units, m.courses)
            for m in (self, other)
        )
        if mine != theirs or not np.array_equal(self.coef, other.coef):
            return False
        if self.covariance is None or other.covariance is None:
            return self.covariance is other.covariance
        return np.array_equal(self.covariance, other.covariance)

    def __hash__(self) -> int:
        return hash((self.states, tuple(self.coef[self.coef != 0.0].tolist())))

    @property
    def inputs(self) -> tuple[str, ...]:
        """Variables of the library that are not states."""
        return tuple(v for v in self.library.variables if v not in self.states)

    def terms(self, state: str) -> dict[str, float]:
        """Term name -> SI coefficient of one equation, in the order of the library."""
        column = self.coef[:, self._equation(state)]
        return {n: float(c) for n, c in zip(self.library.names, column, strict=True) if c != 0.0}

    def intervals(self, state: str, *, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Term name -> lower and upper bound of its coefficient, for Gaussian errors.

        Raises ValueError for a model without covariance.
        """
        if self.covariance is None:
            raise ValueError(
                "intervals need a covariance: this model has none; discover it with the "
                "formulation Weak"
            )
        used = self.coef.T != 0.0
        std = np.zeros(used.shape)
        std[used] = np.sqrt(np.diag(self.covariance))
        row = self._equation(state)
        reach = ndtri(0.5 + 0.5 * level) * std[row, used[row]]
        return {
            name: (value - r, value + r)
            for (name, value), r in zip(self.terms(state).items(), reach.tolist(), strict=True)
        }

    def derivative(
        self, states: Float[np.ndarray, "... n_states"], inputs: Float[np.ndarray, "... n_inputs"]
    ) -> Float[np.ndarray, "... n_states"]:
        """Right-hand side at any number of samples; inputs are in the order of `inputs`.

        NaN outside the domain of a function of the model.
        """
        return self.field.rates(np.concatenate([states, inputs], axis=-1))

    def rollout(
        self,
        trajectory: Run,
        *,
        start: int = 0,
        n_samples: int | None = None,
        initial: Float[np.ndarray, " n_states"] | None = None,
        blow_up: float = 100.0,
        rtol: float = 1e-8,
        limit_s: float = 300.0,
    ) -> Rollout:
        """Integrate from one sample of a trajectory, driven by its inputs (see `courses`).

        The states are scaled by their largest value in the window, so that one tolerance fits all.
        If the equations are stiff, the solver switches to an implicit method. The run ends, marked
        and with a message, after some hundred evaluations per sample or `limit_s` of work.

        Parameters
        ----------
        trajectory : run
            A Trajectory, a table or arrays (t, x), as `discover` takes them.
        start : int, default 0
            Number of the sample to start from.
        n_samples : int, optional
            Number of samples to integrate. None takes all that follow.
        initial : (n_states,) array, optional
            State at that sample, in SI. None takes the data's.
        blow_up : float, default 100.0
            A state that exceeds this many times its largest value in the window ends the run as
            diverged.
        rtol : float, default 1e-08
            Relative tolerance of the solver.
        limit_s : float, default 300.0
            Work in s after which the run ends.

        Returns
        -------
        Rollout
            The states at the times of the trajectory.

        Raises
        ------
        ValueError
            If the window lies outside the trajectory, a variable is missing, or the initial state
            does not hold a finite number for each state.
        """
        run = trajectory_of(trajectory)
        window = run.window(start, run.n_samples if n_samples is None else start + n_samples)
        data, samples = window.columns(self.states), window.columns(self.inputs)
        found = simulate(
            self,
            window.t,
            data[0] if initial is None else check_start(self.states, initial, name="initial"),
            samples,
            blow_up=blow_up,
            rtol=rtol,
            limit_s=limit_s,
            reach=np.abs(data).max(axis=0),
            bound="the data's largest value",
        )
        return replace(found, clock=run.clock)

    def simulate(
        self,
        t: ArrayLike,
        x0: ArrayLike | Mapping[str, float],
        inputs: ArrayLike | Mapping[str, Any] | None = None,
        *,
        blow_up: float = 1e12,
        rtol: float = 1e-8,
        limit_s: float = 300.0,
        draws: int = 0,
        seed: int = 0,
    ) -> Rollout:
        """Integrate freely from the state x0 at t[0]; returns the states at the times t.

        A run that diverges also returns a result, marked `diverged` and with a message. It ends
        when a state exceeds `blow_up` times its scale, or when the solver gives up (see `rollout`).
        The scale of a state is its initial value; if that is zero, what the model's fastest time
        scale makes of it.

        Parameters
        ----------
        t : array_like (samples,)
            Times in s, increasing.
        x0 : array_like (n_states,) or mapping of str to float
            State at t[0], in SI, in order or by name.
        inputs : array_like (samples, n_inputs) or mapping, optional
            Inputs at t, between which they follow the model's `courses`; or, by name, samples, a
            number, or a function of t in s.
        blow_up : float, default 1000000000000.0
            Factor at which a run counts as diverged.
        rtol : float, default 1e-08
            Relative tolerance of the solver.
        limit_s : float, default 300.0
            Work in s after which the run ends.
        draws : int, default 0
            Number of further runs, from the same start, with coefficients drawn from their
            covariance; `Rollout.band` gives their bounds. For the uncertainty of start, noise and
            model as well, see `ep.forecast`.
        seed : int, default 0
            Of the random draws.

        Returns
        -------
        Rollout
            The run. Its `trajectory()` returns it as data.

        Raises
        ------
        ValueError
            If an input is missing or unknown, shapes are wrong, or draws are asked of a model
            without covariance.
        """
        run = simulate(self, t, x0, inputs, blow_up=blow_up, rtol=rtol, limit_s=limit_s)
        run = replace(run, clock=self.clock)
        if not check_count("draws", draws, 0):
            return run
        if self.covariance is None:
            raise ValueError(
                "draws need the covariance of the coefficients: this model has none, since it was "
                "made by hand, or does not explain the data to within their noise"
            )
        coef = draw_coef(self, self.covariance, draws, np.random.default_rng(seed))
        starts = np.tile(check_start(self.states, x0), (draws, 1))
        times = np.asarray(t, dtype=np.float64)
        drive, _ = driven(self.inputs, inputs, times, self.courses)
        reached = np.abs(run.states).max(axis=0, initial=0.0)
        return replace(run, draws=draw_runs(self, run.t, starts, coef, drive=drive, reach=reached))

    def predict(
        self, x: ArrayLike | Run, inputs: ArrayLike | Mapping[str, Any] | None = None
    ) -> Float[np.ndarray, "... n_states"]:
        """Right-hand side at many samples at once, in SI per second.

        Parameters
        ----------
        x : array_like (samples, n_states) or run
            States, or one sample (n_states,), or a Trajectory (or a table with a time column),
            which contains its own inputs.
        inputs : array_like or mapping, optional
            The same number of samples, in the order of `inputs`, or by name.

        Returns
        -------
        (..., n_states) array
            The derivative.

        Raises
        ------
        ValueError
            If a variable is missing or unknown, or shapes are wrong.
        """
        if is_run(x):
            run = trajectory_of(x)
            if inputs is not None:
                raise ValueError(
                    "a Trajectory brings its own inputs: pass its states, or no inputs"
                )
            return self.derivative(run.columns(self.states), run.columns(self.inputs))
        states = np.asarray(x, dtype=np.float64)
        if states.ndim == 0 or states.shape[-1] != len(self.states):
            raise ValueError(
                f"x must have a column for each of {list(self.states)}, got shape {states.shape}"
            )
        return self.derivative(states, inputs_at_samples(self.inputs, inputs, states.shape[:-1]))

    def score(
        self,
        runs: Runs,
        *,
        x_dot: Float[np.ndarray, "samples n_states"] | None = None,
        horizon_s: float | None = None,
    ) -> float:
        """R2 of forecasts over one step, averaged over the states; one is exact.

        From samples all over the runs the model is integrated over the step, and the change that
        it foresees is compared with that of the samples: 1 - SS_res / SS_tot, with SS_tot about the
        mean change. Zero is as good as that nothing changes. Noise in the samples keeps an exact
        law from one: `ep.evaluate(model, runs).one_step` states what it allows.

        Parameters
        ----------
        runs : run, or list or dict of runs
            As `discover` takes them. Samples with missing states are left out.
        x_dot : (samples, n_states) array, optional
            The derivative in SI, in the order of the model's states, of one run. The score is then
            the mean R2 of the right-hand side at the samples against it.
        horizon_s : float, optional
            The step in s. None takes the fewest samples in which every state changes by ten times
            its noise, one if there is none, or by its standard deviation.

        Returns
        -------
        float
            The mean R2.

        Raises
        ------
        ValueError
            If a variable is missing, a shape is wrong, a derivative is constant, or no sample of
            all states is followed by such a step.
        """
        found = trajectories_of(runs, partial=True)
        if x_dot is None:
            return one_step(self, found, horizon_s=horizon_s).score
        (run,), library, shape = found, self.field.library, (found[0].n_samples, len(self.states))
        check_domain([run], library, smooth=False)
        truth = np.asarray(x_dot, dtype=np.float64)
        if truth.shape != shape:
            raise ValueError(
                f"x_dot must have shape {shape}, a row per sample and a column for each of "
                f"{list(self.states)}, got {truth.shape}"
            )
        pairs = zip(truth.T, self.field.rates(run.columns(library.variables)).T, strict=True)
        return float(np.mean([r2(truth=y, prediction=p[None])[0] for y, p in pairs]))

    def text(self, *, digits: int = 3) -> str:
        """Text with one line per equation: `n_i' = -2.62e+05 n_i + 5.48e-14 n_i n_n`."""
        return "\n".join(equation_text(s, self.terms(s), digits=digits) for s in self.states)

    def sympy(self) -> dict[str, sympy.Expr]:
        """State name -> right-hand side as a sympy expression, coefficients as floats."""
        return {state: sum_sympy(self.terms(state)) for state in self.states}

    def latex(self, *, digits: int = 3) -> str:
        """LaTeX `aligned` block with one equation per line."""
        return equations_latex({state: self.terms(state) for state in self.states}, digits=digits)

    def __str__(self) -> str:
        """Equations with units and, where a covariance is known, 95 % intervals."""
        return "\n".join(model_lines(self))

    def __repr__(self) -> str:
        n = np.count_nonzero(self.coef)
        head = f"SparseModel of {len(self.states)} equations, {n} terms"
        return "\n".join([head, *model_lines(self, n_lines=N_LINES - 1)])

    def _repr_html_(self) -> str:
        return model_html(self)

    def _repr_latex_(self) -> str:
        return f"$${self.latex()}$$"

    def to_json(self) -> str:
        """JSON text of the whole model; floats in their shortest exact form."""
        return model_text(self, self.provenance)

    @staticmethod
    def from_json(text: str) -> SparseModel:
        """Inverse of `to_json`, exact. Raises ValueError for anything else."""
        return read_model(text, model_of)

    def save(self, path: str | Path) -> None:
        write_text(Path(path), self.to_json())

    @staticmethod
    def load(path: str | Path) -> SparseModel:
        return read_stored(Path(path), SparseModel.from_json)

    def _equation(self, state: str) -> int:
        if state not in self.states:
            raise ValueError(f"unknown state {state!r}; this model has {list(self.states)}")
        return list(self.states).index(state)

    @cached_property
    def field(self) -> VectorField:
        """The right-hand side over the states, then the inputs, and its derivatives, in SI."""
        return VectorField.of(self.library, [*self.states, *self.inputs], self.coef)


def coef_matrix(
    library: Library, equations: Sequence[Mapping[str, float]]
) -> Float[np.ndarray, "terms equations"]:
    """Matrix of coefficients over the library, from coefficients by term name.

    Parameters
    ----------
    library : Library
        The terms.
    equations : sequence of mapping of str to float
        Coefficients in SI of each equation, by term name.

    Returns
    -------
    (terms, equations) array
        The matrix, zero for other terms.

    Raises
    ------
    ValueError
        If the library lacks a term.
    """
    coef = np.zeros((len(library), len(equations)))
    for k, terms in enumerate(equations):
        coef[[library.index(name) for name in terms], k] = list(terms.values())
    return coef


def model_of(
    library: Library, equations: Mapping[str, Mapping[str, float]], **rest: Any
) -> SparseModel:
    """Model from coefficients by state and term; rest: the other fields of SparseModel."""
    values = list(equations.values())
    return SparseModel(library, list(equations), coef_matrix(library, values), **rest)
