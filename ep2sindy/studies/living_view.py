"""How a model that lives reads: equations, a table of its free run, figures, summary."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from ep2sindy.figures import living as figures
from ep2sindy.library.equations import equation_text
from ep2sindy.model.rollout import Rollout
from ep2sindy.report.document import (
    Block,
    Captioned,
    Section,
    Table,
    Text,
    pictures,
    places,
)
from ep2sindy.studies.living import Living
from ep2sindy.studies.views import (
    coefficients,
    interval_table,
    intervals,
    rollout_tables,
    shown_equation,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CAPTIONS = {
    "free_run": "The living model (colour) integrated freely from the first sample of held-out "
    "time, over the data (grey): the first and the last periods.",
    "cycle": "Its cycle in the plane of two states, over the data (grey), and runs from other "
    "starts.",
    "waveform": "One period by phase, shown twice: samples, their waveform, and the model's.",
}
STARTS = ((0.5, 0.5), (0.5, 2.0), (1.0, 1.0), (2.0, 0.5), (2.0, 2.0))  # times the cycle's mean
N_PERIODS = 12.0  # of a run from another start


def living_models(living: Mapping[str, Living]) -> dict[str, Any]:
    """Models to write, by name."""
    return {f"{name}_living": each.model for name, each in living.items()}


def living_tables(living: Mapping[str, Living]) -> dict[str, pd.DataFrame]:
    if not living:
        return {}
    found = {"living": pd.DataFrame([_row(name, each) for name, each in living.items()])}
    for name, each in living.items():
        found |= rollout_tables(each.held, {f"{name}_living": each.run})
    models = {name: each.model for name, each in living.items()}
    return found | {"coefficients_living": coefficients(models, heading="library")}


def _row(name: str, living: Living) -> dict[str, Any]:
    """One row of a table: how the model runs over held-out time."""
    run = living.run
    row: dict[str, Any] = {
        "library": name,
        "n_terms": int(np.count_nonzero(living.model.coef)),
        "verdict": str(run.verdict),
        "f_error": run.f_error,
        **{f"amplitude_ratio_{state}": ratio for state, ratio in run.amplitude_ratio.items()},
        **{f"waveform_error_{state}": error for state, error in run.waveform_error.items()},
        "periods": run.periods,
        "stability": "" if living.cycle is None else str(living.cycle.stability),
        "share_reaching": living.share,
        "status_by_derivatives": living.by_derivatives.status,
        "verdict_by_derivatives": str(living.by_derivatives.run.verdict),
    }
    return row


def living_section(name: str, living: Living, figure_names: Iterable[str]) -> Section:
    """Equations with intervals, how they run, and what the derivatives' choice does instead."""
    model, run = living.model, living.run
    clock = run.rollout.clock
    blocks: list[Block] = [shown_equation(model, state, clock) for state in model.states]
    blocks += interval_table(model, clock=clock)
    first = model.states[0]
    rows = pd.DataFrame(
        [
            {
                "state": state,
                "frequency": "" if k else clock.frequency_text(run.frequency_Hz[first]),
                "its error": "" if k else f"{places(100 * run.f_error, 2)} %",
                "amplitude (times the data's)": places(run.amplitude_ratio[state], 3),
                "waveform error": places(run.waveform_error[state], 3),
                "verdict": "" if k else run.text,
            }
            for k, state in enumerate(model.states)
        ]
    )
    blocks.append(Table(rows, title=_title(living)))
    blocks += [Text(text) for text in (_note(living), _by_derivatives(living))]
    return Section(f"{name}: a model that {_ending(living)}", [*blocks, *pictures(figure_names)])


def _ending(living: Living) -> str:
    return "lives" if living.run.verdict == "lives" else f"does not live ({living.run.text})"


def _title(living: Living) -> str:
    n = round(living.run.periods) if living.run.periods == living.run.periods else 0
    return f"run freely from one sample over held-out time; in phase for {n} periods"


def _note(living: Living) -> str:
    """Selection, stability, and what the columns are."""
    found = [f"Selection: {living.discovery.note}."]
    if living.cycle is not None and living.share is not None:
        moduli = ", ".join(f"{abs(m):.3g}" for m in living.cycle.multipliers[1:])
        found.append(
            f"Its cycle is {living.cycle.stability}: Floquet multiplier {moduli}; "
            f"{100 * living.share:.0f} % of starts around reach it."
        )
    found.append(
        "Amplitude: ratio of standard deviations; waveform error: RMS difference in standard "
        "deviations of the data."
    )
    return " ".join(found)


def _by_derivatives(living: Living) -> str:
    """What the equations that derivatives select do when they are refined."""
    refined = living.by_derivatives
    text = "; ".join(
        equation_text(state, refined.run.model.terms(state)) for state in refined.run.model.states
    )
    if refined.status == "non_finite":
        return (
            "The equations selected by their derivatives cannot be refined: no trajectory of "
            f"theirs stays finite over two periods ({text})."
        )
    return (
        f"The equations selected by their derivatives, refined as they are ({refined.status}): "
        f"{refined.run.text} ({text})."
    )


def living_figures(name: str, living: Living) -> dict[str, Captioned]:
    """By name; those of a cycle only where there is one."""
    run, held = living.run, living.held
    drawn: dict[str, Any] = {}
    if living.cycle is not None:
        period_s = living.cycle.period_s
        drawn["free_run"] = partial(figures.free_run_figure, held, run.rollout, period_s=period_s)
        if len(living.model.states) > 1:
            drawn["cycle"] = partial(_cycle_figure, living)
        if figures.has_waveform(held, run.rollout):
            drawn["waveform"] = partial(figures.waveform_figure, held, run.rollout)
    return {f"{key}_{name}": Captioned(draw, CAPTIONS[key]) for key, draw in drawn.items()}


def _cycle_figure(living: Living) -> Figure:
    assert living.cycle is not None
    model, cycle, held = living.model, living.cycle, living.held
    order = [model.states.index(name) for name in held.state_names]
    return figures.cycle_figure(
        held, cycle.states[:, order], _paths(living), plane=held.state_names[:2]
    )


def _paths(living: Living) -> list[Rollout]:
    """Runs from starts around the cycle's mean, in the first two states."""
    assert living.cycle is not None
    mean = living.cycle.states.mean(axis=0)
    t = np.linspace(0.0, N_PERIODS * living.cycle.period_s, 1200)
    found = []
    for factors in STARTS:
        start = mean.copy()
        start[:2] *= factors
        found.append(living.model.simulate(t, start, blow_up=30.0))
    return found


def living_summary(living: Living | None) -> dict[str, Any] | None:
    """What `summary.json` says; None for a library that was not searched so."""
    if living is None:
        return None
    model, run, known = living.model, living.run, intervals(living.model)
    return {
        "terms": {state: list(model.terms(state)) for state in model.states},
        "n_terms": int(np.count_nonzero(model.coef)),
        "verdict": str(run.verdict),
        "f_error": run.f_error,
        "amplitude_ratio": dict(run.amplitude_ratio),
        "waveform_error": dict(run.waveform_error),
        "periods": run.periods,
        "floquet": None
        if living.cycle is None
        else [[float(m.real), float(m.imag)] for m in living.cycle.multipliers],
        "stability": None if living.cycle is None else str(living.cycle.stability),
        "share_reaching": living.share,
        "coefficients": {
            state: {
                term: {"value": value, "ci95": None if known is None else known[state][term]}
                for term, value in model.terms(state).items()
            }
            for state in model.states
        },
        "text": model.text(),
        "selection": living.discovery.note,
        "by_derivatives": {
            "status": living.by_derivatives.status,
            "verdict": str(living.by_derivatives.run.verdict),
            "text": living.by_derivatives.run.model.text(),
        },
    }
