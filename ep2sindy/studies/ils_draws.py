"""How far what a refinement does depends on the windows that were drawn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from ep2sindy.model.free_run import FreeRun
from ep2sindy.model.likeness import Verdict
from ep2sindy.report.document import Section, Table

FIGURES = ("f_error", "nrmse", "amplitude", "waveform")


def _figures(run: FreeRun) -> dict[str, float]:
    """Of one free run; amplitude and waveform are those of the state that is farthest off."""
    ratios = np.array(list(run.amplitude_ratio.values()))
    return {
        "f_error": run.f_error,
        "nrmse": run.nrmse,
        "amplitude": float(ratios[np.argmax(np.abs(ratios - 1.0))]),
        "waveform": max(run.waveform_error.values()),
    }


def draws_table(draws: Mapping[str, Sequence[FreeRun]]) -> pd.DataFrame:
    """One row per method and draw of windows: its model run over held-out time."""
    rows = [
        {"method": name, "draw": k, "verdict": str(run.verdict), **_figures(run)}
        for name, runs in draws.items()
        for k, run in enumerate(runs)
    ]
    return pd.DataFrame(rows)


def spread_summary(runs: Sequence[FreeRun]) -> dict[str, Any]:
    """`spread`: lowest and highest of each figure over the draws, and how many live."""
    if not runs:
        return {}
    found: dict[str, Any] = {
        "n_draws": len(runs),
        "n_living": sum(run.verdict is Verdict.LIVES for run in runs),
    }
    for name, (low, high) in _spread(runs).items():
        found[name] = [low, high]
    return {"spread": found}


def _spread(runs: Sequence[FreeRun]) -> dict[str, tuple[float, float]]:
    """Lowest and highest of each figure, of the draws that have it; NaN where none has."""
    found = {}
    for name in FIGURES:
        values = np.array([_figures(run)[name] for run in runs])
        known = values[np.isfinite(values)]
        found[name] = (float(known.min()), float(known.max())) if known.size else (np.nan, np.nan)
    return found


def spread_section(draws: Mapping[str, Sequence[FreeRun]]) -> Section:
    """A row per method: what its figures range over."""
    rows = []
    for name, runs in draws.items():
        spread = _spread(runs)
        low, high = (100.0 * value for value in spread["f_error"])
        row = {
            "method": name,
            "live": f"{sum(run.verdict is Verdict.LIVES for run in runs)} of {len(runs)}",
            "frequency error": _range(low, high, "+.2f", " %"),
        }
        row |= {key: _range(*spread[key], ".3f") for key in ("nrmse", "amplitude", "waveform")}
        rows.append(row)
    n = max(map(len, draws.values()))
    return Section(
        f"Over {n} draws of windows",
        [
            Table(
                pd.DataFrame(rows),
                title="lowest and highest, over held-out time from its first sample",
                note="Amplitude and waveform are those of the state that is farthest off.",
            )
        ],
    )


def _range(low: float, high: float, form: str, unit: str = "") -> str:
    return "-" if np.isnan(low) else f"{low:{form}} to {high:{form}}{unit}"
