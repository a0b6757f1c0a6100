"""One figure of one result: what `run.plot()`, `found.plot()` and their like draw.

They are called by name, by `draw` of `runtime/drawing.py`, and drawn by the functions that draw the
figures of the experiments.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.result import Discovery
from ep2sindy.figures.fronts import front_figure
from ep2sindy.figures.living import cycle_figure, free_run_figure, paths_off
from ep2sindy.figures.operating import cycle_figure as law_cycle_figure
from ep2sindy.figures.series import data_figure
from ep2sindy.model.free_run import FreeRun
from ep2sindy.model.stability import LimitCycle
from ep2sindy.operating.law import OperatingLaw
from ep2sindy.operating.map import law_map, map_points
from ep2sindy.operating.records import OperatingRecord
from ep2sindy.regression.front import ParetoFront
from ep2sindy.runtime.values import check_positive
from ep2sindy.signals.spectrum import dominant_frequency

PERIODS = 20.0  # shown of a record that has more
HARMONICS = 10.0  # shown of its spectrum


def _show_in_notebooks() -> None:
    """Let a notebook show figures as images, as it does by itself after the first of pyplot."""
    if "ipykernel" not in sys.modules:
        return
    from IPython import get_ipython  # loaded already
    from IPython.core.pylabtools import select_figure_formats

    shell = get_ipython()
    known = shell.display_formatter.formatters.values() if shell is not None else ()
    if known and not any(Figure in each.type_printers for each in known):
        select_figure_formats(shell, {"png"})


_show_in_notebooks()


def run_plot(run: Trajectory, *, duration_s: float | None, f_max_Hz: float | None) -> Figure:
    """The states of a record and their spectra; see `Trajectory.plot`."""
    for name, value in (("duration_s", duration_s), ("f_max_Hz", f_max_Hz)):
        if value is not None:
            check_positive(name, value)
    whole_s, highest_Hz = float(run.t[-1] - run.t[0]), 0.5 / run.dt_s
    fastest_Hz = max(dominant_frequency(run.t, column) for column in run.states.T)
    if fastest_Hz > 0.0:
        whole_s = min(whole_s, PERIODS / fastest_Hz)
        highest_Hz = min(highest_Hz, HARMONICS * fastest_Hz)
    return data_figure(run, duration_s=duration_s or whole_s, f_max_Hz=f_max_Hz or highest_Hz)


def discovery_plot(found: Discovery) -> Figure:
    """The candidates of every equation; see `Discovery.plot`."""
    return front_figure(found.fronts, label=found.method.selection.label)


def front_plot(front: ParetoFront) -> Figure:
    """The candidates of one equation; see `ParetoFront.plot`."""
    return front_figure({front.equation: front}, label="score")


def free_run_plot(run: FreeRun) -> Figure:
    """The run over its record; see `FreeRun.plot`."""
    states = run.record.columns(run.model.states)
    record = replace(run.record, states=states, state_names=run.model.states, missing=None)
    slowest_Hz = min(dominant_frequency(record.t, column) for column in record.states.T)
    period_s = 1.0 / slowest_Hz if slowest_Hz > 0.0 else np.inf
    return free_run_figure(record, run.rollout, period_s=period_s)


def cycle_plot(cycle: LimitCycle, run: Trajectory | None) -> Figure:
    """The cycle in the plane of two states; see `LimitCycle.plot`."""
    return cycle_figure(run, cycle, paths_off(cycle), plane=cycle.model.states[:2])


def law_plot(
    law: OperatingLaw,
    records: Sequence[OperatingRecord],
    *,
    n_points: int,
    labels: Mapping[str, str],
) -> Figure:
    """The cycle of a law over its parameters; see `OperatingLaw.plot_map`."""
    grid = map_points([record.parameters for record in records], n_points)
    if not grid:
        raise ValueError(
            f"a map is over one or two parameters: this law has {list(law.parameters)}; hold the "
            "others, and draw law.model_at(...) yourself"
        )
    rows = pd.DataFrame([point.row for point in law_map(law, records, grid)])
    seen = [
        {
            **record.parameters,
            "branch": "law",
            "f_kHz": 1e-3 * record.cycle.frequency_Hz,
            "relative_amplitude": record.relative_amplitude,
        }
        for record in records
    ]
    return law_cycle_figure(
        rows, pd.DataFrame(seen), law.points, branch="law", parameters=law.parameters,
        labels=labels,
    )  # fmt: skip
