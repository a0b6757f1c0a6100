"""Curves to draw: what a figure shows of runs, between which limits, under which names."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ep2sindy.figures.frames import Limits, framing
from ep2sindy.library.units import Clock
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
    clock: Clock,
) -> Curves:
    """What lies in the first `duration_s`, over a time that the clock shows."""
    since = t - t[:1]
    shown = since <= duration_s
    return Curves(clock.scale(duration_s)[0] * since[shown], values[shown])


def limits_of(data: Curves, models: Mapping[str, Curves], rare: float = 0.0) -> list[Limits]:
    together = np.concatenate([curves.y for curves in models.values()])
    return [framing(*pair, rare=rare) for pair in zip(data.y.T, together.T, strict=True)]


def diverged_within(rollouts: Mapping[str, Rollout], duration_s: float) -> set[str]:
    """Names of the runs that stop before the end of what is shown."""
    return {name for name, r in rollouts.items() if r.diverged and r.lasted_s <= duration_s}


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
    return f"diverges at {rollout.lasted_text or 'once'}"
