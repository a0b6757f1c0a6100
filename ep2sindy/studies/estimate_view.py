"""How an estimate of states and coefficients together reads: the noise, the fit, the rivals."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.estimation.estimate import Estimate
from ep2sindy.report.document import Block, Section, Table, Text

NOISE = (
    "Noise: standard deviation of what the model leaves of the samples. Memory: its correlation "
    "from one sample to the next, 0 for white noise. Grows: how much of its variance grows with "
    "the square of the state. Kurtosis: 3 where it is normal, more with outliers."
)

FITS = (
    "The model explains the samples as far as their noise: what is left looks like noise, and "
    "an exact trajectory is likelier than one that leaves the model."
)


def estimate_section(name: str, found: Estimate, data: Trajectory) -> Section:
    """What the samples say of their noise, whether the model explains them, and what else may."""
    blocks: list[Block] = [
        Table(noise_table(found, data), title="noise of the samples", note=NOISE),
        Text(found.misfit or FITS, warning=bool(found.misfit)),
    ]
    if found.few:
        blocks.append(Text(found.few, warning=True))
    if found.rivals:
        rivals = [
            (f"{each.state}'", ", ".join(t.replace("*", " ") for t in each.terms), odds(each.odds))
            for each in found.rivals
        ]
        rows = pd.DataFrame(rivals, columns=["equation", "terms", "odds against the chosen"])
        blocks.append(Table(rows, title="other supports that may be"))
    elif not found.misfit:
        blocks.append(Text("No other support of an equation has odds above 1:1000."))
    return Section(f"{name}: what the samples say", blocks, level=3)


def noise_table(found: Estimate, data: Trajectory) -> pd.DataFrame:
    """By state: size of the noise, in SI and beside the state's spread, and what it is like."""
    rows = []
    for k, state in enumerate(found.model.states):
        noise, spread = float(found.noise_std[k]), float(data.columns([state]).std())
        rows.append(
            {
                "state": state,
                "noise (std)": f"{noise:.3g} {data.units[state]}".removesuffix(" 1"),
                "of the state's std": f"{100.0 * noise / spread:.2g} %",
                "memory": f"{found.memory[k]:.2f}",
                "grows": f"{100.0 * found.growth[k]:.3g} %",
                "kurtosis": f"{found.kurtosis[k]:.3g}".replace("nan", ""),
            }
        )
    return pd.DataFrame(rows)


def odds(value: float) -> str:
    """`1:27`; 1:1 is even."""
    return f"1:{1.0 / value:.3g}"


def estimate_summary(found: Estimate) -> dict[str, Any]:
    """What `summary.json` says, in SI."""
    states = found.model.states
    return {
        "noise_std": dict(zip(states, np.asarray(found.noise_std).tolist(), strict=True)),
        "memory": dict(zip(states, np.asarray(found.memory).tolist(), strict=True)),
        "noise_growth": dict(zip(states, np.asarray(found.growth).tolist(), strict=True)),
        "noise_kurtosis": dict(zip(states, np.asarray(found.kurtosis).tolist(), strict=True)),
        "delays_s": dict(zip(states, np.asarray(found.delays_s).tolist(), strict=True)),
        "remarks": list(found.remarks),
        "flow_error": found.flow_error,
        "misfit": found.misfit or None,
        "few": found.few or None,
        "rivals": [
            {"state": r.state, "terms": list(r.terms), "odds": r.odds} for r in found.rivals
        ],
    }
