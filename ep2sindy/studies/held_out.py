"""Known terms fitted in several ways to the first part of a record, judged on the rest."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from time import process_time

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from ep2sindy.constraints.fit import constrained_fit
from ep2sindy.constraints.relations import Constraint
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import Library
from ep2sindy.model.integrated import Integrated, integrate
from ep2sindy.model.model import SparseModel
from ep2sindy.refinement.problem import Iteration
from ep2sindy.refinement.refine import Refinement, loss_against_window, refine
from ep2sindy.refinement.windows import dominant_window
from ep2sindy.regression.rows import Formulation
from ep2sindy.signals.spectrum import dominant_frequency

DIVERGED = 10.0  # residual, in std, of samples that a run does not reach


@dataclass(frozen=True, eq=False)
class HeldOutRun:
    """A model integrated over the held-out part.

    f_error: dominant frequency of the first state against the data's, minus one.
    amplitude_ratio: by state, standard deviation against the data's. NaN where it diverged; the
    frequency also where it died out.
    """

    integrated: Integrated
    f_error: float
    amplitude_ratio: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Judged:
    """A fit and what it does on the held-out part.

    cpu_s: of the fit, without that of the model it starts from. refinement: None for least
    squares. from_sample: started at the first sample; from_fit: at a start fitted to the first
    samples, for one sample may lie off every orbit of the model.
    """

    model: SparseModel
    cpu_s: float
    refinement: Refinement | None
    from_sample: HeldOutRun
    from_fit: HeldOutRun

    @property
    def status(self) -> str | None:
        """Of a refinement; least squares has none."""
        return self.refinement.status if self.refinement else None


def parted(run: Trajectory, held_out: float) -> tuple[Trajectory, Trajectory]:
    """The first part of a record, and the last `held_out` of its samples.

    Raises ValueError for a share that leaves either of them under 20 samples.
    """
    n_train = round(run.n_samples * (1.0 - held_out))
    if min(n_train, run.n_samples - n_train) < 20:
        raise ValueError(
            f"held_out={held_out} must leave 20 samples on either side: the data have "
            f"{run.n_samples}"
        )
    return run.window(0, n_train), run.window(n_train, run.n_samples)


def least_squares_model(
    train: Trajectory,
    library: Library,
    constraint: Constraint,
    formulation: Formulation,
    *,
    rng: np.random.Generator,
) -> SparseModel:
    """Least squares under the constraint, in one form of the regression.

    Without covariance: smoothed rows and overlapping windows are not independent, and intervals
    that took them for it would be too narrow.
    """
    model = constrained_fit(
        formulation.assemble([train], library, rng=rng),
        constraint,
        units=train.units,
        provenance={"formulation": repr(formulation), "trajectories": train.label},
    )
    return replace(model, covariance=None)


def constrained_beside_base(
    train: Trajectory,
    held: Trajectory,
    library: Library,
    constraints: Mapping[str, Constraint],
    formulation: Formulation,
    *,
    rng: np.random.Generator,
) -> dict[str, Judged]:
    """One model per constraint, fitted to the same rows and judged on the held-out part."""
    return {
        name: _judged_rows(train, held, library, constraint, formulation, stream)
        for (name, constraint), stream in zip(
            constraints.items(), _same(rng, len(constraints)), strict=True
        )
    }


def refined_beside_base(
    train: Trajectory,
    held: Trajectory,
    library: Library,
    free: Constraint,
    constrained: Constraint,
    *,
    formulation: Formulation,
    weak: Formulation,
    n_windows: int,
    window: int | None,
    callback: Callable[[str, Iteration], None] | None = None,
    rng: np.random.Generator,
) -> dict[str, Judged]:
    """Base, weak and constrained least squares, and both refinements of base and constrained.

    free, constrained: of the same terms, without and with relations. callback: is told the
    method's name with every iteration.
    """
    streams = rng.spawn(5)
    fits = {
        "base": _judged_rows(train, held, library, free, formulation, streams[0]),
        "weak": _judged_rows(train, held, library, free, weak, streams[1]),
        "constrained": _judged_rows(train, held, library, constrained, formulation, streams[2]),
    }
    for name, start, constraint, stream in (
        ("ils", "base", free, streams[3]),
        ("ils_constrained", "constrained", constrained, streams[4]),
    ):
        watch = None if callback is None else _told(callback, name)
        begun = process_time()
        refinement = refine(
            fits[start].model,
            [train],
            n_windows=n_windows,
            window=window,
            constraint=constraint,
            rng=stream,
            callback=watch,
        )
        fits[name] = judged(refinement, held, cpu_s=process_time() - begun)
    return fits


def refined_by_window(
    starts: Mapping[str, tuple[SparseModel, Constraint]],
    train: Trajectory,
    held: Trajectory,
    windows: Sequence[int],
    *,
    n_windows: int,
    rng: np.random.Generator,
) -> dict[str, dict[int, Judged]]:
    """Refine once per start and window length, and judge on the held-out part.

    starts: name -> model and constraint. cpu_s is not known one by one: NaN.
    """
    return {
        name: {
            window: judged(refinement, held)
            for window, refinement in loss_against_window(
                model, [train], windows, n_windows=n_windows, constraint=constraint, rng=stream
            ).items()
        }
        for (name, (model, constraint)), stream in zip(
            starts.items(), rng.spawn(len(starts)), strict=True
        )
    }


def judged(
    fit: SparseModel | Refinement, held: Trajectory, *, cpu_s: float = float("nan")
) -> Judged:
    """Integrate a fitted model over the held-out part, from its first sample and from a fit."""
    refinement = fit if isinstance(fit, Refinement) else None
    model = fit.model if isinstance(fit, Refinement) else fit
    start = fitted_start(model, held)
    return Judged(
        model=model,
        cpu_s=cpu_s,
        refinement=refinement,
        from_sample=held_out_run(model, held, initial=None),
        from_fit=held_out_run(model, held, initial=start),
    )


def held_out_run(
    model: SparseModel, held: Trajectory, *, initial: Float[np.ndarray, " n_states"] | None
) -> HeldOutRun:
    """Integrate over all of the held-out part, and compare."""
    integrated = integrate(model, held, held.n_samples, initial=initial)
    first = held.state_names[0]
    f_data_Hz = dominant_frequency(held.t, held.columns([first])[:, 0])
    ratio = integrated.rollout.states.std(axis=0) / held.columns(model.states).std(axis=0)
    if integrated.rollout.diverged:
        ratio = np.full(len(model.states), np.nan)
    return HeldOutRun(
        integrated=integrated,
        f_error=integrated.frequency_Hz[first] / f_data_Hz - 1.0,
        amplitude_ratio=dict(zip(model.states, ratio.tolist(), strict=True)),
    )


def fitted_start(model: SparseModel, run: Trajectory) -> Float[np.ndarray, " n_states"]:
    """The initial state whose trajectory is closest to the first one and a half periods.

    Distances in standard deviations of the data; the search begins at the first sample.
    """
    n_samples = min(dominant_window([run], model.states), run.n_samples)
    data = run.window(0, n_samples).columns(model.states)
    std = run.columns(model.states).std(axis=0)

    def residual(start: np.ndarray) -> np.ndarray:
        rollout = model.rollout(run, n_samples=n_samples, initial=start * std, rtol=1e-6)
        strayed = np.full(data.shape, DIVERGED)
        strayed[: len(rollout.t)] = (rollout.states - data[: len(rollout.t)]) / std
        return strayed.ravel()

    return least_squares(residual, data[0] / std, diff_step=1e-4).x * std


def _judged_rows(
    train: Trajectory,
    held: Trajectory,
    library: Library,
    constraint: Constraint,
    formulation: Formulation,
    rng: np.random.Generator,
) -> Judged:
    begun = process_time()
    model = least_squares_model(train, library, constraint, formulation, rng=rng)
    return judged(model, held, cpu_s=process_time() - begun)


def _told(callback: Callable[[str, Iteration], None], name: str) -> Callable[[Iteration], None]:
    return lambda iteration: callback(name, iteration)


def _same(rng: np.random.Generator, n: int) -> list[np.random.Generator]:
    """Generators that draw the same: what differs between fits is then the constraint alone."""
    seed = int(rng.integers(2**63))
    return [np.random.default_rng(seed) for _ in range(n)]
