"""Curves to draw: what a figure shows of runs, between which limits, under which names."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ep2sindy.figures.frames import Limits, framing
from ep2sindy.library.units import prefixed
from ep2sindy.model.rollout import Rollout


@dataclass(frozen=True, eq=False)
class Curves:
    """One curve per state over a shared abscissa, in the axis's own prefix."""

    x: Float[np.ndarray, " points"]
    y: Float[np.ndarray, "points n_states"]


def first_part(
    t: Float[np.ndarray, " samples"],
    values: Float[np.ndarray, "samples n_states"],
    duration_s: float,
) -> Curves:
    """What lies in the first `duration_s`."""
    since = t - t[:1]
    shown = since <= duration_s
    return Curves(time_unit(duration_s)[0] * since[shown], values[shown])


def limits_of(data: Curves, models: Mapping[str, Curves], rare: float = 0.0) -> list[Limits]:
    together = np.concatenate([curves.y for curves in models.values()])
    return [framing(*pair, rare=rare) for pair in zip(data.y.T, together.T, strict=True)]


def diverged_within(rollouts: Mapping[str, Rollout], duration_s: float) -> set[str]:
    """Names of the runs that stop before the end of what is shown."""
    lasted = {name: r.t[-1] - r.t[0] if len(r.t) else 0.0 for name, r in rollouts.items()}
    return {name for name, r in rollouts.items() if r.diverged and lasted[name] <= duration_s}


def run_labels(rollouts: Mapping[str, Rollout], verdicts: Mapping[str, str]) -> dict[str, str]:
    """A name, and below it what becomes of the run where that is known.

    verdicts: by name; a run that diverged says itself when, counted from its start.
    """
    found = {}
    for name, rollout in rollouts.items():
        verdict = when_it_diverges(rollout) if rollout.diverged else verdicts.get(name)
        found[name] = f"{name}\n({verdict})" if verdict else name
    return found


def when_it_diverges(rollout: Rollout) -> str:
    """`diverges at 182 µs`, counted from its start."""
    lasted_s = float(rollout.t[-1] - rollout.t[0]) if len(rollout.t) else 0.0
    factor, unit = time_unit(lasted_s)
    return f"diverges at {factor * lasted_s:.3g} {unit}" if lasted_s else "diverges at once"


def time_unit(duration_s: float) -> tuple[float, str]:
    """Factor and unit that bring a duration between 1 and 1000: (1e6, "µs")."""
    factor, prefix = prefixed(duration_s)
    return factor, f"{prefix.replace('u', 'µ')}s"
