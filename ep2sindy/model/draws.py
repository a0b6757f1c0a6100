"""Many runs of one model that differ by chance: in start, in coefficients, and by process noise."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from ep2sindy.data.numbers import zero_to_one
from ep2sindy.model.inputs import Curve
from ep2sindy.model.many import WindowSteps, run_many
from ep2sindy.model.vector_field import Equations, VectorField

# Substeps between two samples: the fewest whose central run differs from that of twice as many by
# no more than this fraction of its largest states.
MAX_SUBSTEPS, ACCURATE = 64, 1e-4

# A run that goes farther than this many times the largest states of start and record has diverged.
BLOW_UP = 100.0


def draw_normal(
    mean: Float[np.ndarray, " n"],
    covariance: Float[np.ndarray, "n n"],
    n_draws: int,
    rng: np.random.Generator,
) -> Float[np.ndarray, "draws n"]:
    """Draws from a normal distribution, of variables whose sizes may differ by any factor.

    Of all roots of the correlation the symmetric one is unique, whatever the signs of eigenvectors:
    the same seed gives the same draws in any unit.
    """
    size = np.sqrt(zero_to_one(np.maximum(np.diag(covariance), 0.0)))
    values, vectors = np.linalg.eigh(covariance / np.outer(size, size))
    root = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    return mean + (rng.standard_normal((n_draws, len(mean))) @ root) * size


def draw_coef(
    model: Equations,
    covariance: Float[np.ndarray, "_ _"] | None,
    n_draws: int,
    rng: np.random.Generator,
) -> Float[np.ndarray, "draws terms n_states"]:
    """Coefficients drawn with their covariance; all alike if it is None.

    covariance: of the coefficients that are not zero, by equation, as in `SparseModel`.
    """
    coef = np.repeat(model.coef.T[None], n_draws, axis=0)
    used = model.coef.T != 0.0
    if covariance is not None and used.any():
        coef[:, used] = draw_normal(model.coef.T[used], covariance, n_draws, rng)
    return coef.transpose(0, 2, 1)


def draw_runs(
    model: Equations,
    t: Float[np.ndarray, " samples"],
    starts: Float[np.ndarray, "draws n_states"],
    coef: Float[np.ndarray, "draws terms n_states"],
    *,
    drive: Curve | None = None,
    process_std: Float[np.ndarray, " n_states"] | None = None,
    process_step_s: float = 1.0,
    reach: Float[np.ndarray, " n_states"],
    rng: np.random.Generator | None = None,
) -> Float[np.ndarray, "draws samples n_states"]:
    """Integrate a model once for every draw, by classical Runge-Kutta steps between the samples.

    drive: the inputs between these samples. process_std: standard deviation of the process noise of
    every state in process_step_s; None for none. reach: largest states expected, in SI. A run
    that goes a hundred times farther has diverged, and is NaN from there on.
    """
    if len(t) < 2:  # of a run that ended at its start
        return starts[:, None][:, : len(t)]
    bound = BLOW_UP * zero_to_one(reach)
    variables = [*model.states, *model.inputs]
    centre = VectorField.of(model.library, variables, coef.mean(axis=0)[None])
    steps = _fine_enough(centre, starts.mean(axis=0), t, drive, bound)
    moves = None
    if rng is not None and process_std is not None and process_std.any():
        size = process_std * np.sqrt(np.diff(t) / process_step_s)[:, None]
        drawn = size[:, None] * rng.standard_normal((len(size), *starts.shape))
        moves = np.ascontiguousarray(drawn.transpose(1, 0, 2)[:, None])
    fields = VectorField.of(model.library, variables, coef)
    still = np.zeros(len(bound))
    return run_many(fields, starts[:, None], steps, centre=still, reach=bound, moves=moves)[:, 0]


def _fine_enough(
    field: VectorField,
    start: Float[np.ndarray, " n_states"],
    t: Float[np.ndarray, " samples"],
    drive: Curve | None,
    bound: Float[np.ndarray, " n_states"],
) -> WindowSteps:
    """Steps between the samples that follow the central run."""
    n, begin = 1, np.zeros(1, dtype=np.int64)
    run = runs_from(field, start[None], t, drive, begin, len(t), n, bound)[0]
    some = np.linspace(0, len(t) - 2, min(len(t) - 1, 40)).astype(np.int64)
    while n < MAX_SUBSTEPS:
        finer = runs_from(field, start[None], t, drive, begin, len(t), 2 * n, bound)[0]
        off = step_error(field, finer[some], t, drive, some, n, bound) / zero_to_one(
            np.abs(run).max(axis=0)
        )
        if not np.isfinite(run).all():
            off = np.full(1, np.inf if np.isfinite(finer).all() or n < 8 else 0.0)
        if off.max() <= ACCURATE:
            break
        n, run = 2 * n, finer
    return WindowSteps.along(t, drive, begin, len(t), n)


def step_error(
    field: VectorField,
    starts: Float[np.ndarray, "starts n_states"],
    t: Float[np.ndarray, " samples"],
    drive: Curve | None,
    first: Int[np.ndarray, " starts"],
    n_substeps: int,
    bound: Float[np.ndarray, " n_states"],
) -> Float[np.ndarray, "starts n_states"]:
    """Difference that twice as many substeps make from some samples to the next ones, in SI.

    A chaotic run leaves its neighbours: single steps, not whole runs, are compared.
    """
    coarse, fine = (
        runs_from(field, starts, t, drive, first, 2, n, bound)[:, 1]
        for n in (n_substeps, 2 * n_substeps)
    )
    return np.abs(coarse - fine)


def runs_from(
    field: VectorField, starts: np.ndarray, t: np.ndarray, drive: Curve | None,
    first: np.ndarray, n_samples: int, n_substeps: int, bound: np.ndarray,
) -> Float[np.ndarray, "starts samples n_states"]:  # fmt: skip
    """Runs of one model from a state (starts, n_states) at each of the samples `first` of t.

    A run with a state beyond the bound, (n_states,), is NaN from there on.
    """
    steps = WindowSteps.along(t, drive, first, n_samples, n_substeps)
    return run_many(field, starts[None], steps, centre=np.zeros(len(bound)), reach=bound)[0]


def starts_around(states: np.ndarray, n_starts: int, spread: tuple[float, float]) -> np.ndarray:
    """Starts (starts, n_states) that fill a box; see `basin_stability`."""
    from scipy.stats.qmc import Halton  # its import takes a quarter of a second

    fraction = Halton(states.shape[1], scramble=False).random(n_starts + 1)[1:]  # the first is zero
    mean = states.mean(axis=0)
    reach = spread[1] * 0.5 * np.ptp(states, axis=0)
    low, high = np.log(spread)
    one_sign = (states > 0.0).all(axis=0) | (states < 0.0).all(axis=0)
    around = mean * np.exp(low + (high - low) * fraction)
    return np.where(one_sign, around, mean + reach * (2.0 * fraction - 1.0))
