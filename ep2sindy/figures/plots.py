"""One figure of one value: `ep.plot`, by the functions that draw the figures of the experiments."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import singledispatch
from types import MappingProxyType

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.result import Discovery
from ep2sindy.figures.fronts import front_figure
from ep2sindy.figures.operating import cycle_figure as law_cycle_figure
from ep2sindy.figures.series import cycle_figure, data_figure, free_run_figure
from ep2sindy.forecasting.evaluation import Evaluation
from ep2sindy.model.stability import LimitCycle
from ep2sindy.operating.law import OperatingLaw
from ep2sindy.operating.map import law_map, map_points
from ep2sindy.operating.records import OperatingRecord
from ep2sindy.regression.front import ParetoFront
from ep2sindy.runtime.values import check_positive
from ep2sindy.signals.spectrum import dominant_frequency

PERIODS = 20.0  # shown of a record that has more


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


@singledispatch
def plot(value: object, *rest: object, **settings: object) -> Figure:
    """Draw one value as a matplotlib figure, as the pages of the experiments show it.

    What is drawn depends on the kind of the value:

    - `plot(run, duration_s=None, f_max_Hz=None)`: the states of a `Trajectory`, a row each, and
      their power spectra. duration_s is how much of the record is shown, None for twenty periods of
      the fastest state, or all; f_max_Hz is the end of the spectra, None for ten times its
      frequency.
    - `plot(found)`: the candidates of every equation of a `Discovery`, the selected ones marked:
      error against number of terms after a regression, score after a search of trajectories.
    - `plot(found.fronts["x"])`: the same for one equation.
    - `plot(free)`: the model of an `Evaluation` over its record, the first periods and the last.
    - `plot(cycle, run=None)`: a `LimitCycle` in the plane of the first two states, with runs from
      other starts, and the samples of `run` behind it.
    - `plot(law, records, n_points=25, labels={})`: frequency and amplitude of the cycle of an
      `OperatingLaw` over its one or two parameters, with n_points along each. The cycles of the
      records of the operating points start the law's models, and are drawn as well. labels are the
      names of the parameters on the axes.

    Parameters
    ----------
    value : object
        What is drawn.
    *rest : object
        Further values, by position.
    **settings : object
        Further values, by name.

    Returns
    -------
    Figure
        The figure.

    Raises
    ------
    TypeError
        If there is no drawing of such a value.
    ValueError
        If a number is not positive, or a law has more than two parameters.

    Examples
    --------
    >>> run = ep.lotka_volterra().trajectory()
    >>> figure = ep.plot(run, duration_s=20.0)
    >>> len(figure.axes)  # series and spectrum of x and of y
    4
    """
    kinds = ", ".join(sorted(kind.__name__ for kind in plot.registry if kind is not object))
    raise TypeError(f"plot draws a {kinds}, got {type(value).__name__}")


@plot.register
def _(run: Trajectory, *, duration_s: float | None = None, f_max_Hz: float | None = None) -> Figure:
    for name, value in (("duration_s", duration_s), ("f_max_Hz", f_max_Hz)):
        if value is not None:
            check_positive(name, value)
    whole_s = float(run.t[-1] - run.t[0])
    fastest_Hz = max(dominant_frequency(run.t, column) for column in run.states.T)
    if fastest_Hz > 0.0:
        whole_s = min(whole_s, PERIODS / fastest_Hz)
    return data_figure(run, duration_s=duration_s or whole_s, f_max_Hz=f_max_Hz)


@plot.register
def _(found: Discovery) -> Figure:
    return front_figure(found.fronts, label=found.method.selection.label)


@plot.register
def _(front: ParetoFront) -> Figure:
    return front_figure({front.equation: front}, label="score")


@plot.register
def _(run: Evaluation) -> Figure:
    states = run.record.columns(run.model.states)
    record = replace(run.record, states=states, state_names=run.model.states, missing=None)
    slowest_Hz = min(dominant_frequency(record.t, column) for column in record.states.T)
    period_s = 1.0 / slowest_Hz if slowest_Hz > 0.0 else np.inf
    return free_run_figure(record, run.rollout, period_s=period_s)


@plot.register
def _(cycle: LimitCycle, run: Trajectory | None = None) -> Figure:
    return cycle_figure(run, cycle)


@plot.register
def _(
    law: OperatingLaw,
    runs: Sequence[Trajectory],
    *,
    n_points: int = 25,
    labels: Mapping[str, str] = MappingProxyType({}),
) -> Figure:
    records = [OperatingRecord(run) for run in runs]
    grid = map_points([record.parameters for record in records], n_points)
    if not grid:
        raise ValueError(
            f"a map is over one or two parameters: this law has {list(law.parameters)}; hold the "
            "others, and draw law.at(...) yourself"
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
        rows, pd.DataFrame(seen), branch="law", parameters=law.parameters, labels=labels
    )
