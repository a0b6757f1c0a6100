"""Parts of arrays that are too large to be read at once, in the order of the file."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping
from itertools import product
from math import prod
from typing import Any

import numpy as np
import xarray as xr

from ep2sindy.trust.memory import check_memory

# xarray must keep times as numbers, whatever their attribute `units` says.
UNDECODED: Any = {"decode_times": False, "decode_timedelta": False}

AT_ONCE = 2**28  # bytes of an array up to which it is read once when its file is opened

BLOCK_VALUES = 2**22  # values of one variable in a block: 32 MB of float64


def blocks_of(data: xr.Dataset | xr.DataArray) -> Iterator[dict[Hashable, slice]]:
    """Slices, by dimension, of parts of about BLOCK_VALUES values that together are the data.

    A chunk of the file is compressed as one and read as one, so that no part divides a chunk of the
    data's largest variable. Chunks are joined from the last dimension on, in which they follow each
    other in the file. Without chunks, what is divided is the first dimension.
    """
    variables = [data] if isinstance(data, xr.DataArray) else [*data.data_vars.values()]
    largest = max(variables, key=lambda each: each.size)
    chunks: Mapping[Hashable, int] = largest.encoding.get("preferred_chunks", {})
    sizes = {dim: data.sizes[dim] for dim in dict.fromkeys([*largest.dims, *data.sizes])}
    lengths = {dim: min(size, chunks.get(dim, 1)) for dim, size in sizes.items()}
    for dim, size in reversed(sizes.items()):
        n_joined = BLOCK_VALUES // prod(lengths.values())
        lengths[dim] = min(size, lengths[dim] * max(1, n_joined))
    cuts = [range(0, size, lengths[dim]) for dim, size in sizes.items()]
    for starts in product(*cuts):
        yield {dim: slice(k, k + lengths[dim]) for dim, k in zip(sizes, starts, strict=True)}


def read_whole(array: xr.DataArray) -> np.ndarray:
    """All values of an array; raises ValueError if they would take more memory than is free."""
    check_memory(
        float(array.nbytes),
        f"{array.name}, of shape {array.shape},",
        hint="average over a zone, which is read in parts, or give data.chunks, such as "
        "{time: 1000}",
    )
    return array.values


def scale(array: xr.DataArray, *, factor: float, offset: float) -> xr.DataArray:
    """`array * factor + offset`; of a large array that its file holds, computed when it is used."""
    if array.nbytes <= AT_ONCE:
        return array * factor + offset
    packing = {"scale_factor": factor, "add_offset": offset}
    return unpack(array, packing).assign_attrs(array.attrs).rename(array.name)


def unpack(array: xr.DataArray, packing: Mapping[str, Any]) -> xr.DataArray:
    """Numbers that attributes such as `scale_factor` packed, computed when they are used."""
    packed = xr.Dataset({"it": array.drop_attrs().assign_attrs(packing)})
    return xr.decode_cf(packed, decode_coords=False, **UNDECODED)["it"].drop_attrs()
