"""A grid in blocks of points, and finished blocks kept on disk for a run that goes on."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
import xarray as xr

from ep2sindy.data.fields import SPACE
from ep2sindy.runtime.files import WriteError, replacing, sweep


@dataclass(frozen=True)
class Block:
    """A rectangle of grid points: slices by axis of the field."""

    slices: Mapping[str, slice]

    @property
    def n_points(self) -> int:
        return int(np.prod([part.stop - part.start for part in self.slices.values()]))

    @property
    def name(self) -> str:
        return "_".join(f"{axis}{part.start}-{part.stop}" for axis, part in self.slices.items())


def blocks_of(field: xr.Dataset, n_points: int) -> list[Block]:
    """Rectangles of at most `n_points` points: whole lines along the last axis where one fits.

    Neighbours in a file are read together that way. Raises ValueError for n_points below one.
    """
    if n_points < 1:
        raise ValueError(f"a block needs a point: block_points={n_points} came")
    steps, room = {}, n_points
    for axis in reversed([axis for axis in SPACE if axis in field.dims]):
        steps[axis] = min(field.sizes[axis], room)
        room = max(1, room // steps[axis])
    blocks = [Block({})]
    for axis in reversed(steps):
        n = field.sizes[axis]
        parts = [slice(k, min(k + steps[axis], n)) for k in range(0, n, steps[axis])]
        blocks = [Block({**block.slices, axis: part}) for block in blocks for part in parts]
    return blocks


@dataclass(frozen=True)
class Kept:
    """Finished blocks in a folder, each file whole or not there."""

    folder: Path

    def __post_init__(self) -> None:
        sweep(self.folder)

    def holds(self, block: Block) -> bool:
        return self._path(block).exists()

    def read(self, block: Block) -> dict[str, np.ndarray] | None:
        """A finished block, or None where there is none that can be read."""
        try:
            with np.load(self._path(block), allow_pickle=False) as stored:
                return dict(stored)
        except (OSError, ValueError, EOFError, BadZipFile):
            return None

    def write(self, block: Block, done: Mapping[str, np.ndarray]) -> None:
        """Raises OSError, naming the way out, where the disk takes no more."""
        try:
            with replacing(self._path(block)) as temporary:
                np.savez(temporary, **done)  # type: ignore[arg-type]
        except WriteError as error:
            raise OSError(
                f"a finished block must be kept on disk: writing to {self.folder} failed with "
                f"{error.reason!r}; the blocks before it are kept: mend that, and start "
                "the same run again"
            ) from error

    def clear(self) -> None:
        """Remove the finished blocks, once the result that they make is written.

        Another run of the same study may be at work in the folder: then that stays.
        """
        for path in self.folder.glob("[!.]*.npz"):  # not what is being written
            path.unlink(missing_ok=True)
        with suppress(OSError):
            self.folder.rmdir()

    def _path(self, block: Block) -> Path:
        return self.folder / f"{block.name}.npz"
