"""Figures of a simulated discharge: profiles along its axis, and maps over z and time."""

from __future__ import annotations

from textwrap import fill
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from jaxtyping import Float
from matplotlib.figure import Figure

from ep2sindy.data.fields import cell_edges, channel_length_m
from ep2sindy.figures import style
from ep2sindy.figures.maps import CM
from ep2sindy.figures.style import COLOURS, DATA, GREY, TITLE, WIDTH

PROFILES = ("n_i", "n_n", "u_iz", "T_e_eV", "E_z", "ionization")
MAPS = {"n_n": "viridis", "n_i": "magma"}  # legible with any colour vision, and in grey
ENDS = ("mean", "low", "high", "min", "max")  # of a profile
BAND_PERCENT = (5, 95)  # inner band of a profile, in percentiles
MS = 1e3


def profile_table(field: xr.Dataset) -> pd.DataFrame:
    """Along the axis z (m), of each variable: mean in time, 5 %, 95 %, minimum and maximum."""
    columns = {"z": field["z"].values}
    for name in (name for name in PROFILES if name in field):
        values = along_z(field[name])
        low, high = np.percentile(values, BAND_PERCENT, axis=0)
        profiles = (values.mean(axis=0), low, high, values.min(axis=0), values.max(axis=0))
        columns |= {f"{name}_{end}": x for end, x in zip(ENDS, profiles, strict=True)}
    return pd.DataFrame(columns)


def profile_figure(field: xr.Dataset) -> Figure:
    """Mean profiles with bands of 5 to 95 % and of the full range; the channel's exit is dashed."""
    table, names = profile_table(field), [name for name in PROFILES if name in field]
    figure, axes = style.make_grid(
        len(names), width=3.0, height=2.5, extra=0.4, sharex=True,
        x_label="distance from the anode (cm)",
    )  # fmt: skip
    z, band = CM * field["z"].values, "{} to {} % of the time".format(*BAND_PERCENT)
    for ax, name in zip(axes, names, strict=True):
        values = table[[f"{name}_{end}" for end in ENDS]].to_numpy().T
        mean, low, high, least, most = values
        ax.fill_between(z, least, most, color=COLOURS[5], alpha=0.3, lw=0, label="whole range")
        ax.fill_between(z, low, high, color=COLOURS[0], alpha=0.35, lw=0, label=band)
        ax.plot(z, mean, color=DATA, lw=1.5, label="mean")
        ax.set_title(fill(_words(field[name]), 28), fontsize=TITLE)
        ax.set_ylabel(style.unit_text(field[name].attrs["units"]))
        for end in _exit_cm(field):
            ax.axvline(end, color=DATA, lw=1.0, ls="--")
        ax.margins(x=0.0)
    style.legend_above(figure, axes[0].get_legend_handles_labels()[0])
    return figure


def space_time_figure(field: xr.Dataset, window: slice) -> Figure:
    """The currents, and below them neutral and ion density over time and z, for a few periods."""
    names = [name for name in MAPS if name in field]
    shown = field.isel(time=window)
    time = MS * shown["time"].values
    size, heights = (WIDTH, 1.7 + 2.4 * len(names)), [1.0, *[1.7] * len(names)]
    figure, grid = style.make_panels(1 + len(names), 1, size, sharex=True, heights=heights)
    axes = grid[:, 0]
    axes[0].plot(time, shown["I_d"].values, color=DATA, lw=1.3, label="discharge")
    if "I_beam" in field:
        beam: dict[str, Any] = {"color": COLOURS[0], "ls": "--", "label": "ion beam"}
        axes[0].plot(time, shown["I_beam"].values, lw=1.3, **beam)
    axes[0].set_ylabel("current (A)")
    axes[0].axhline(0.0, color=GREY, lw=0.8)  # a steady current must not look like a moving one
    style.legend_above(figure, axes[0].get_legend_handles_labels()[0])
    edges = CM * cell_edges(field["z"].values.astype(float))
    for ax, name in zip(axes[1:], names, strict=True):
        values, unit = along_z(shown[name]), style.unit_text(field[name].attrs["units"])
        look: dict[str, Any] = {"cmap": MAPS[name], "vmin": 0.0, "rasterized": True}
        drawn = ax.pcolormesh(cell_edges(time), edges, values.T, **look)
        label = f"{_words(field[name])}\n({unit})"
        figure.colorbar(drawn, ax=ax, pad=0.02, aspect=14, label=label)
        ax.set_ylabel("distance from\nthe anode (cm)")
        for end in _exit_cm(field):
            ax.axhline(end, color="white", lw=1.0, ls="--")
    axes[0].set_xlim(time[0], time[-1])
    axes[-1].set_xlabel("time after the warm-up (ms)")
    return figure


def along_z(array: xr.DataArray) -> Float[np.ndarray, "time z"]:
    """Values on (time, z); fields over r are averaged by area over the cells with plasma."""
    if "r" in array.dims:
        array = array.weighted(array["r"]).mean("r")
    return array.transpose("time", "z").values.astype(float)


def _words(array: xr.DataArray) -> str:
    return str(array.attrs.get("long_name", array.name))


def _exit_cm(field: xr.Dataset) -> list[float]:
    """The end of the channel, if the field gives its position."""
    length_m = channel_length_m(field.attrs)
    return [] if length_m is None else [CM * length_m]


def last_periods(t: Float[np.ndarray, " time"], f_kHz: float, periods: float) -> slice:
    """The last few periods of a record; a tenth of the record if there is no frequency."""
    tenth_s = 0.1 * (t[-1] - t[0])
    duration_s = periods / (1e3 * f_kHz) if np.isfinite(f_kHz) and f_kHz > 0.0 else tenth_s
    start = int(np.searchsorted(t, t[-1] - duration_s))
    return slice(max(0, min(start, t.size - 16)), t.size)
