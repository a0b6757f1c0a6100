"""Output of HallThruster.jl."""

from __future__ import annotations

import json
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from ep2sindy.data.readers.source import Reader, Source, leaves


def read_hallthruster(path: Path) -> Source:
    """Time-resolved JSON output of HallThruster.jl, SI but for Tev in eV.

    A name is a path inside a frame, counted from 0: `ions.Xe.0.n` is the density of Xe+,
    `neutrals.Xe.n`, `Tev`, `discharge_current`, with time `t` and grid `z`. Layout of versions
    0.19 to 0.22 (output.frames); also read are 0.18 (`ni.0`) and earlier ones (a bare list of
    frames, `ni_1`).
    Source: https://um-pepl.github.io/HallThruster.jl (Use JSON for input and output).
    """
    content = json.loads(path.read_text(encoding="utf-8"))
    frames = content.get("output", {}).get("frames") if isinstance(content, dict) else content
    if not frames or not isinstance(frames[0], dict):
        raise ValueError("it holds no output.frames; run the simulation with save_time_resolved")

    def read(name: str) -> xr.DataArray:
        if name == "z":  # repeated in every frame, since the grid stays
            return xr.DataArray(np.array(frames[0]["z"], dtype=np.float64))
        rows = [reduce(_step_into, name.split("."), frame) for frame in frames]
        return xr.DataArray(np.array(rows, dtype=np.float64))

    return Source(path, list(leaves(frames[0])), read)


def _step_into(node: Any, key: str) -> Any:
    return node[int(key)] if isinstance(node, list) else node[key]


HALLTHRUSTER = Reader("HallThruster.jl", read_hallthruster, form="other", endings=(".json",))
