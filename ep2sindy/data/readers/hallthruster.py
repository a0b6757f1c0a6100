"""Reader of HallThruster.jl's output."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from ep2sindy.data.readers.source import FileSource, Reader, leaves
from ep2sindy.runtime.files import read_json

UNITS = {
    "t": "s", "z": "m", "grid": "m", "cell_centers": "m", "n": "m^-3", "ni": "m^-3", "nn": "m^-3",
    "ne": "m^-3", "u": "m/s", "ui": "m/s", "ue": "m/s", "Tev": "eV", "B": "T", "E": "V/m",
    "potential": "V", "thrust": "N", "discharge_current": "A", "discharge_voltage": "V",
    "ion_current": "A", "electron_current": "A",
}  # fmt: skip


def read_hallthruster(path: Path) -> FileSource:
    """Read time-resolved JSON output of HallThruster.jl, or JSON that holds plain columns.

    Values are in SI, except Tev in eV. A name is a path inside a frame, with indices from 0:
    `ions.Xe.0.n` (density of Xe+), `neutrals.Xe.n`, `Tev`, `discharge_current`, time `t`, grid `z`.
    Supported layouts: versions 0.19 to 0.22 (output.frames); frames with `t` and `grid` next to
    them; 0.18 (`ni.0`, `ui.0`, `nn`) and earlier (`ni_1`), a bare list of frames; without frames,
    plain columns. Data next to the frames are named by their path from the top.
    Source: https://um-pepl.github.io/HallThruster.jl (Use JSON for input and output).
    """
    content = read_json(path.read_text(encoding="utf-8-sig"))
    frames, beside = _split_frames(content)
    columns = {name: v for name, v in leaves(beside).items() if _is_column(v)}
    if not frames and not columns:
        raise ValueError("it holds no output.frames; run the simulation with save_time_resolved")
    flat = [leaves(frame) for frame in frames]
    inside = [*flat[0]] if flat else []

    def read(name: str) -> xr.DataArray:
        if name not in inside:
            values = columns[name]
        else:  # the fixed grid is repeated in every frame
            values = flat[0][name] if name == "z" else [frame[name] for frame in flat]
        return xr.DataArray(np.array(values, dtype=np.float64))

    names = [*inside, *(name for name in columns if name not in inside)]
    channel_m = _channel_m(content) if isinstance(content, dict) else None
    words = f"{len(frames)} frames" if frames else "columns, no frames"
    return FileSource(path, names, read, words=words, channel_m=channel_m, units=_units(names))


def _split_frames(content: Any) -> tuple[Sequence[Mapping[str, Any]], Any]:
    """Split the content into the frames and the data next to them."""
    if isinstance(content, list):
        frames, beside = content, {}
    else:
        output = content.get("output", {})
        holder = output if isinstance(output, dict) and "frames" in output else content
        frames = holder.get("frames") or []
        # The input and the averages describe the whole run and are not samples.
        beside = {k: v for k, v in holder.items() if k not in ("frames", "input", "average")}
        beside.pop("output", None)
    if not all(isinstance(frame, dict) for frame in frames):
        return [], beside
    return frames, beside


def _is_column(value: Any) -> bool:
    """True for a list, or nested lists, of at least two numbers."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        return False
    return array.ndim > 0 and array.size > 1


def _units(names: Sequence[str]) -> dict[str, str]:
    """Units in HallThruster.jl's output, by the last part of each path that is not an index."""
    lasts = {name: [part for part in name.split(".") if not part.isdigit()][-1] for name in names}
    return {name: UNITS[last] for name, last in lasts.items() if last in UNITS}


def _channel_m(content: Mapping[str, Any]) -> float | None:
    """Length of the channel in m, from the input that newer versions store with the output."""
    try:
        node = content["input"]["config"]["thruster"]["geometry"]["channel_length"]
    except (KeyError, TypeError):
        return None
    return float(node) if isinstance(node, int | float) else None


HALLTHRUSTER = Reader("HallThruster.jl", read_hallthruster, form="other", endings=(".json",))
