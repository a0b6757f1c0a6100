"""Display of a model: equations with units and intervals, on a screen or in a notebook."""

from __future__ import annotations

import html
from collections.abc import Mapping

from ep2sindy.library.equations import Sum, equation_html, equation_parts
from ep2sindy.library.relations import Constraint
from ep2sindy.library.roles import groups_of
from ep2sindy.library.units import SECONDS, Clock
from ep2sindy.model.vector_field import Equations
from ep2sindy.runtime.screen import N_LINES, cut, wrap

MAX_TERMS = 40  # largest number of terms shown per equation in a notebook


def model_lines(
    model: Equations, held: Constraint | None = None, *, n_lines: int = N_LINES
) -> list[str]:
    """Equations with their units, then the units of the variables; at most n_lines.

    held: from a search under `Roles`, by whose processes the equations are then written.
    """
    foot = cut(_units_text(model))
    room = n_lines - 1
    if len(model.states) > room:
        left = len(model.states) - room + 1
        states, tail = model.states[: room - 1], [f"... {left} more equations", foot]
    else:
        states, tail = model.states, [foot]
    # Every equation gets one line, and an even share of the lines that are left over.
    spare = n_lines - len(tail) - len(states)
    lines: list[str] = []
    for k, state in enumerate(states):
        terms, reach = _per_time_unit(model, state, held)
        parts = equation_parts(terms, reach=reach) or ["0"]
        parts[-1] += f" [{_rate_unit(model, state)}]"
        own = wrap([f"{state}' =", *parts], what="terms", n_lines=1 + spare // (len(states) - k))
        spare -= len(own) - 1
        lines += own
    return [*lines, *tail]


def model_html(model: Equations, held: Constraint | None = None) -> str:
    """Equations with their units and the units of the variables, as HTML for a notebook."""
    lines = []
    for state in model.states:
        terms, reach = _per_time_unit(model, state, held)
        left = max(0, len(terms) - MAX_TERMS) if isinstance(terms, Mapping) else 0
        if isinstance(terms, Mapping):
            terms = dict(list(terms.items())[:MAX_TERMS])
        text = equation_html(state, terms, reach=reach)
        more = f" ... {left} more terms" if left else ""
        lines.append(f"<div>{text}{more} &nbsp; [{html.escape(_rate_unit(model, state))}]</div>")
    return "\n".join([*lines, f"<div><small>{html.escape(_units_text(model))}</small></div>"])


def half_widths(model: Equations, state: str) -> Mapping[str, float]:
    """Half-width of each coefficient's 95 % interval; empty without a covariance."""
    if model.covariance is None:
        return {}
    return {name: (high - low) / 2.0 for name, (low, high) in model.intervals(state).items()}


def grouped(model: Equations, held: Constraint | None, clock: Clock = SECONDS) -> Mapping[str, Sum]:
    """State -> terms of its equation per time unit; by process, if roles hold the model."""
    if held is None or not held.processes:
        return {
            state: {name: clock.seconds * value for name, value in model.terms(state).items()}
            for state in model.states
        }
    coef = {state: model.terms(state) for state in model.states}
    reach = {state: half_widths(model, state) for state in model.states}
    return groups_of(held, coef, reach, per=clock.seconds)


def _per_time_unit(
    model: Equations, state: str, held: Constraint | None
) -> tuple[Sum, Mapping[str, float]]:
    """Coefficients and half-widths per unit of the model's clock."""
    terms, widths = grouped(model, held, model.clock)[state], half_widths(model, state)
    return terms, {name: model.clock.seconds * value for name, value in widths.items()}


def _rate_unit(model: Equations, state: str) -> str:
    return model.clock.rate_unit(model.units[state])


def _units_text(model: Equations) -> str:
    known = [f"{name} in {unit}" for name, unit in model.units.items() if unit != "1"]
    return ", ".join([*known, f"t in {model.clock.unit}"]) + (
        "" if model.covariance is None else "; ± 95 % intervals"
    )
