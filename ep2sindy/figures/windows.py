"""The figure of loss and free runs against the length of windows."""

from __future__ import annotations

import pandas as pd
from matplotlib.figure import Figure

from ep2sindy.figures import style
from ep2sindy.figures.style import COLOURS, DATA, GREY, TITLE, WIDTH


def loss_against_window_figure(rows: pd.DataFrame, *, period: float) -> Figure:
    """Loss of refinement, and frequency error and nrmse on held-out data, by window length.

    rows: fit, window (samples), loss, f_error, nrmse, f_error_started, nrmse_started.
    period: of the data, in samples.
    """
    figure, (axes,) = style.make_panels(1, 3, (WIDTH, 3.6), sharex=True)
    lengths = [int(n) for n in rows["window"].unique()]
    titles = ("loss (1: a constant)", "frequency error (%)", "nrmse on held-out data")
    for (name, each), colour in zip(rows.groupby("fit", sort=False), COLOURS, strict=False):
        look = {"color": colour, "marker": "o", "ms": 3.5, "lw": 1.2}
        axes[0].plot(each["window"], each["loss"], label=name, **look)
        for ax, key, factor in ((axes[1], "f_error", 100.0), (axes[2], "nrmse", 1.0)):
            ax.plot(each["window"], factor * each[key].abs(), label=name, **look)
            dashed = look | {"ls": "--", "mfc": "none"}
            started = factor * each[f"{key}_started"].abs()
            ax.plot(each["window"], started, label=f"{name}, start fitted", **dashed)
    for ax, title in zip(axes, titles, strict=True):
        ax.set(xlabel="samples in a window", xscale="log")
        style.name_ticks(ax.xaxis, lengths, [str(n) for n in lengths])
        ax.axvline(period, color=DATA, lw=0.8, ls=":")
        ax.set_title(title, fontsize=TITLE)
        ax.grid(which="major", alpha=0.3)
    axes[0].set_ylim(bottom=0.0)
    axes[1].axhline(1.0, color=GREY, lw=0.8)
    axes[1].set_yscale("log")
    axes[2].set_ylim(bottom=0.0)
    style.legend_above(figure, axes[1].get_legend_handles_labels()[0])
    return figure
