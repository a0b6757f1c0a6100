"""Maps of the pointwise study and its regimes; curves if the field has a single axis.

A panel shows cells coloured over z and r. Over a single axis, values are points on an ordinate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import xarray as xr
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, Colormap, ListedColormap, Normalize, SymLogNorm, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.typing import ColorType

from ep2sindy.data.fields import SPACE, cell_edges
from ep2sindy.discovery.regimes import Regimes
from ep2sindy.figures import style
from ep2sindy.figures.style import COLOURS, DATA, MORE_COLOURS, SMALL, TITLE, WIDTH
from ep2sindy.library.equations import latex_derivative, latex_term_name
from ep2sindy.thruster.parameters import Thruster

ABSENT = "#dcdcdc"  # colour of a term not in the equation; a masked cell stays white
DECADE = 10.0  # magnitudes along a line with a larger range get a logarithmic scale
GAP = 0.12  # half-width of the colour bar's middle, which stands for absent terms
CM = 100.0  # per m
PANEL_WIDTH = 1.9  # inches

SOURCE, SINK = colormaps["Reds"](0.75), colormaps["Blues"](0.75)
STATUS_COLOURS = ("#dceaf7", "#ffffff", COLOURS[3], COLOURS[4], COLOURS[1])
# Neither has a shade near white, which marks a cell without a value.
FRACTION_COLOURS = colormaps["viridis"]
COUNT_COLOURS = ListedColormap(colormaps["Purples"](np.linspace(0.35, 1.0, 256)))

HALF = r"the same at $R^2 \times$ fraction of bootstraps = 0.5"


def coefficient_maps(result: xr.Dataset, *, outline: Thruster | None = None) -> Figure:
    """Every coefficient over the field: a row per equation, a column per term, signed and log.

    result: from `studies.pointwise`. Red is a positive coefficient (a source), blue a negative one;
    darker is larger in magnitude. Grey is a term that is not in the equation, white a point without
    equations. Colours fade to grey as R2 of the equation, times the fraction of the bootstraps that
    have the term, falls to 0. Each column has one scale of whole decades. Terms that no point
    selected have no column. outline: the thruster whose channel is drawn. If the field has a single
    axis, magnitudes are drawn as points over it.
    """
    terms = [t for t in result["term"].values if (np.abs(result["coef"].sel(term=t)) > 0).any()]
    if not terms:
        raise ValueError("coefficient maps need a term: no point of the study selected any")
    coef, trust = result["coef"].sel(term=terms), _trust(result)
    flat = len(space_axes(coef)) == 1
    shape = coef.sizes["equation"], len(terms)
    width, height = _panel_size(coef, min(PANEL_WIDTH, (WIDTH - 0.8) / len(terms) - 0.35))
    size = max(shape[1] * width + 0.8, 5.5), shape[0] * height + 1.1
    figure, axes = style.make_panels(*shape, size, sharex=True, sharey="col" if flat else True)
    for column, term in zip(axes.T, terms, strict=True):
        column[0].set_title(f"${latex_term_name(str(term))}$", fontsize=TITLE)
        if flat:
            _draw_signed_points(list(column), coef.sel(term=term), trust.sel(term=term))
        else:
            _draw_signed_maps(figure, list(column), coef.sel(term=term), trust.sel(term=term))
        column[-1].set_xlabel(f"{space_axes(coef)[0]} (cm)")
    for ax in axes.flat:
        _finish(ax, coef, outline)
        if not flat:
            ax.label_outer(remove_inner_ticks=False)
    for row, equation in zip(axes, coef["equation"].values, strict=True):
        row[0].set_ylabel(f"${latex_derivative(str(equation))}$\n\n{row[0].get_ylabel()}")
    (half,) = _fade(SOURCE, np.array([0.5]))
    entries: dict[str, Any] = {"source (+)": SOURCE, "sink (−)": SINK, HALF: half}
    if not flat:
        entries |= {"not selected": ABSENT}
    patches = [Patch(color=colour, label=label) for label, colour in entries.items()]
    style.legend_above(figure, patches)
    return figure


def _trust(result: xr.Dataset) -> xr.DataArray:
    """Trust, 0 to 1, by equation, term and point: R2 times fraction of bootstraps with the term."""
    fraction = result["inclusion"].fillna(1.0)  # unknown where there were no bootstraps
    return result[r2_name(result)].clip(0.0, 1.0) * fraction


def _fade(
    colour: ColorType, trust: Float[np.ndarray, " points"]
) -> Float[np.ndarray, "points rgb"]:
    """Blend from the colour at trust 1 to the grey of absent terms at trust 0."""
    full, none = (np.array(list(to_rgb(shade))) for shade in (colour, ABSENT))
    return none + trust[:, None] * (full - none)


def r2_name(result: xr.Dataset) -> str:
    """Name of R2: on the held-out rows, or on the training rows if none were held out."""
    return "r2_test" if np.isfinite(result["r2_test"]).any() else "r2_train"


def _draw_signed_maps(
    figure: Figure, column: Sequence[Axes], coef: xr.DataArray, opacity: xr.DataArray
) -> None:
    """Draw one term in all equations, with a colour bar; its grey middle ends at +-10^low."""
    low, high = _decades(coef.values)
    ends, middle = 10.0 ** np.arange(low, high + 1), 0.9 * GAP / (1.0 - GAP) * (high - low)
    norm = SymLogNorm(ends[0], linscale=middle, vmin=-ends[-1], vmax=ends[-1])
    scale = _signed_colours()
    for ax, values, shown in zip(column, coef, opacity, strict=True):
        least = np.copysign(np.maximum(np.abs(values), ends[0]), values).where(values != 0.0, 0.0)
        draw_map(ax, least.where(values.notnull()), scale, norm, opacity=shown)
        ax.set_facecolor(ABSENT)
    bar = figure.colorbar(
        ScalarMappable(norm, scale), ax=column, location="bottom", aspect=14, pad=0.02, shrink=0.95
    )
    bar.set_label(" / ".join(dict.fromkeys(map(_coef_unit, coef))), fontsize=SMALL, labelpad=1)
    labels = f"$-10^{{{high}}}$", rf"$\pm 10^{{{low}}}$", f"$10^{{{high}}}$"
    bar.set_ticks([-ends[-1], 0.0, ends[-1]], labels=labels)
    bar.set_ticks([*-ends[1:-1], *ends[1:-1]], minor=True)
    bar.ax.tick_params(labelsize=SMALL, length=2)


def _coef_unit(coef: xr.DataArray) -> str:
    unit = str(coef["coef_units"].values)
    return "dimensionless" if unit == "1" else style.unit_text(unit)


def _decades(coef: Float[np.ndarray, "*shape"]) -> tuple[int, int]:
    """Whole decades that span the magnitudes but for the smallest and largest hundredth."""
    magnitudes = np.log10(np.abs(coef[np.isfinite(coef) & (coef != 0.0)]))
    low, high = np.percentile(magnitudes, [1, 99])
    return int(np.floor(low)), max(int(np.ceil(high)), int(np.floor(low)) + 1)


def _signed_colours() -> Colormap:
    n = 200
    half = round((1.0 - GAP) * n) + 1  # the faintest shade begins before GAP, because of rounding
    shades = np.linspace(0.3, 1.0, half)
    blues, reds = colormaps["Blues"](shades[::-1]), colormaps["Reds"](shades)
    return ListedColormap([*blues, *[ABSENT] * (2 * (n - half)), *reds]).with_extremes(bad="white")


def _draw_signed_points(column: Sequence[Axes], coef: xr.DataArray, trust: xr.DataArray) -> None:
    """Draw magnitudes of one term in all equations along the single axis, by sign."""
    (axis,) = space_axes(coef)
    sizes = np.abs(coef.values[np.isfinite(coef.values) & (coef.values != 0.0)])
    scale = "log" if sizes.max() > DECADE * sizes.min() else "linear"
    for ax, values, shown in zip(column, coef, trust, strict=True):
        ax.set_yscale(scale)
        if not (np.abs(values) > 0.0).any():
            middle: dict[str, Any] = {"ha": "center", "va": "center", "transform": ax.transAxes}
            ax.text(0.5, 0.5, "not selected", color="#777777", fontsize=SMALL, **middle)
        for sign, colour, marker in ((1, SOURCE, "^"), (-1, SINK, "v")):
            chosen = sign * values.values > 0
            at, magnitudes = CM * coef[axis].values[chosen], np.abs(values.values[chosen])
            faded = _fade(colour, shown.fillna(1.0).values[chosen])
            ax.scatter(at, magnitudes, s=10, marker=marker, c=faded, linewidths=0)
        ax.set_ylabel(_coef_unit(values), labelpad=2)


def regime_map(regimes: Regimes, *, outline: Thruster | None = None) -> Figure:
    """Map of the regimes, their certainty, and the terms active in each.

    White marks points without equations.
    """
    n = regimes.n_regimes
    colours = MORE_COLOURS if n <= len(MORE_COLOURS) else colormaps["tab20"](np.arange(n) % 20)
    labels = regimes.labels.where(regimes.labels >= 0)
    panels = [
        Panel("regime", labels, ListedColormap(list(colours[:n])), _whole(n), bar=False),
        Panel("confidence", regimes.confidence, FRACTION_COLOURS),
    ]
    figure = _draw_panels(panels, outline, width=3.7, extra=0.75 + 0.2 * n)
    patches = [Patch(color=colours[k], label=_regime_text(regimes, k)) for k in range(n)]
    style.legend_above(figure, patches, title="terms that act in each regime")
    return figure


def _regime_text(regimes: Regimes, regime: int) -> str:
    """`0, 8 points: n_i' n_i u_iz; n_n' 1, n_n`, with each name typeset."""
    row = regimes.table[regimes.table["regime"] == regime].iloc[0]
    acting = "; ".join(
        f"${latex_derivative(state)}$: {', '.join(f'${latex_term_name(t)}$' for t in terms) or '0'}"
        for state, terms in regimes.equations(regime).items()
    )
    return f"{regime}, {row['n_points']} point{'s' if row['n_points'] > 1 else ''}: {acting}"


def quality_maps(result: xr.Dataset, *, outline: Thruster | None = None) -> Figure:
    """R2 and number of terms of every equation, and the status of the points if not all are fitted.

    R2 is on the held-out rows, or on the training rows if none were held out. Values below 0 are
    drawn as 0.
    """
    name, panels = r2_name(result), []
    rows = "held-out" if name == "r2_test" else "training"
    counts = _whole(max(1, int(result["n_terms"].max())) + 1, 256)
    for equation in result["equation"].values:
        of, own = f"${latex_derivative(str(equation))}$", result.sel(equation=equation)
        panels += [
            Panel(f"{of}: $R^2$, {rows}", own[name].clip(min=0.0), FRACTION_COLOURS),
            Panel(f"{of}: number of terms", own["n_terms"], COUNT_COLOURS, counts),
        ]
    status, patches = result["status"], []
    if (status != 0).any():
        meanings = str(status.attrs["flag_meanings"]).split()
        norm, statuses = _whole(len(meanings)), ListedColormap(list(STATUS_COLOURS))
        panels.append(Panel("status of the points", status * 1.0, statuses, norm, bar=False))
        for k, (meaning, colour) in enumerate(zip(meanings, STATUS_COLOURS, strict=False)):
            if n := int((status == k).sum()):
                text = f"{meaning.replace('_', ' ')} ({n})"
                patches.append(Patch(facecolor=colour, edgecolor=DATA, lw=0.5, label=text))
    figure = _draw_panels(panels, outline, width=2.7, extra=0.9)
    style.legend_above(figure, patches)
    return figure


@dataclass(frozen=True, eq=False)
class Panel:
    """A map with a title. bar: False for values that stand for kinds, which a legend names."""

    title: str
    values: xr.DataArray
    colours: Colormap
    norm: Normalize = field(default_factory=lambda: Normalize(0.0, 1.0))
    bar: bool = True


def _whole(n: int, n_colours: int | None = None) -> BoundaryNorm:
    """Norm of the whole numbers below n."""
    return BoundaryNorm(np.arange(n + 1) - 0.5, n_colours or n)


def _draw_panels(
    panels: Sequence[Panel], outline: Thruster | None, *, width: float, extra: float
) -> Figure:
    """Draw the maps, as many in a row as fit. width: of each, and extra: height, in inches."""
    first = panels[0].values
    size, x_label = _panel_size(first, width), f"{space_axes(first)[0]} (cm)"
    figure, axes = style.make_grid(
        len(panels), width=size[0], height=size[1], extra=extra, sharex=True,
        sharey=len(space_axes(first)) == 2, x_label=x_label,
    )  # fmt: skip
    for ax, panel in zip(axes, panels, strict=True):
        (draw_values if panel.bar else draw_map)(ax, panel.values, panel.colours, panel.norm)
        ax.set_title(panel.title, fontsize=TITLE)
        _finish(ax, first, outline)
        if not ax.get_subplotspec().is_first_col():  # type: ignore[union-attr]
            ax.set_ylabel("")
    return figure


def space_axes(array: xr.DataArray | xr.Dataset) -> list[str]:
    return [axis for axis in SPACE if axis in array.dims]


def _panel_size(array: xr.DataArray, width: float) -> tuple[float, float]:
    """Size of a panel with its margins, so that a map of this width keeps the field's proportions.

    All are in inches.
    """
    spans = [float(np.ptp(_edges(array, axis))) for axis in space_axes(array)]
    height = width * min(max(spans[1] / spans[0], 0.25), 2.0) if len(spans) == 2 else 1.3
    return width + 0.35, height + 0.45


def _edges(array: xr.DataArray, axis: str) -> Float[np.ndarray, " edges"]:
    """Edges of the cells in m; a single point gets 1 mm on either side."""
    points = array[axis].values.astype(np.float64)
    return cell_edges(points) if len(points) > 1 else points[0] + np.array([-1e-3, 1e-3])


def draw_map(
    ax: Axes,
    values: xr.DataArray,
    colours: Colormap,
    norm: Normalize,
    *,
    opacity: xr.DataArray | None = None,
) -> None:
    """Draw cells by colour; a field with a single axis becomes a strip.

    opacity: 0 to 1 for the same cells; NaN counts as 1.
    """
    space = space_axes(values)
    z = CM * _edges(values, space[0])
    if len(space) == 1:
        ax.pcolormesh(z, [0.0, 1.0], values.values[None], cmap=colours, norm=norm)
        ax.set_yticks([])
        return
    r = CM * _edges(values, "r")
    mesh = ax.pcolormesh(z, r, values.transpose("r", "z").values, cmap=colours, norm=norm)
    if opacity is not None:
        mesh.set(alpha=opacity.fillna(1.0).transpose("r", "z").values)
    ax.set_aspect("equal")


def draw_values(ax: Axes, values: xr.DataArray, colours: Colormap, norm: Normalize) -> None:
    """Draw a map with its colour bar; with a single axis, points on an ordinate."""
    space = space_axes(values)
    if len(space) == 1:
        ax.plot(CM * values[space[0]].values, values.values, ".", color=DATA, ms=4)
        low, high = norm.vmin or 0.0, norm.vmax or 0.0
        ax.set_ylim(low - 0.05 * (high - low), high + 0.05 * (high - low))
        if isinstance(norm, BoundaryNorm):
            ax.set_yticks(_middles(norm))
        return
    draw_map(ax, values, colours, norm)
    bar = ax.figure.colorbar(ScalarMappable(norm, colours), ax=ax, shrink=0.7, aspect=12, pad=0.02)
    if isinstance(norm, BoundaryNorm):
        bar.set_ticks(_middles(norm))
    bar.ax.tick_params(labelsize=SMALL)


def _middles(norm: BoundaryNorm) -> list[float]:
    return list(np.add(norm.boundaries[1:], norm.boundaries[:-1]) / 2)


def _finish(ax: Axes, array: xr.DataArray, outline: Thruster | None) -> None:
    """Draw the channel's outline; label r, or show the full range of a single axis."""
    space = space_axes(array)
    if len(space) == 1:
        ax.set_xlim(*CM * _edges(array, space[0])[[0, -1]])
    else:
        ax.set_ylabel("r (cm)")
    if outline is not None:
        _draw_channel(ax, space, outline)


def _draw_channel(ax: Axes, space: Sequence[str], thruster: Thruster) -> None:
    """Draw walls, anode and front face as one line, the exit plane dashed; keep the limits."""
    length, inner, outer = (
        CM * x for x in (thruster.channel_length, thruster.inner_radius, thruster.outer_radius)
    )
    limits = ax.get_xlim(), ax.get_ylim()
    if len(space) == 1:
        for place in [length] if space == ["z"] else [inner, outer]:
            ax.axvline(place, color=DATA, lw=0.8, ls="--")
    else:
        ax.plot([length, length], [inner, outer], color=DATA, lw=0.8, ls="--")
        bottom, top = limits[1]
        walls = [min(bottom, inner), inner, inner, outer, outer, max(top, outer)]
        ax.plot([length, length, 0.0, 0.0, length, length], walls, color=DATA, lw=1.2)
    ax.set(xlim=limits[0], ylim=limits[1])
