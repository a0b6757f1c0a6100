"""Windows of weak rows: weighted sums over short stretches of neighbouring samples."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import block_diag, csr_array


@dataclass(frozen=True, eq=False)
class Windows:
    """Test functions phi on stretches of neighbouring samples, one for every row.

    mean, slope: (rows, samples), weights that are stored for all samples of each row's stretch and
    for no others. mean @ values is the integral of phi * values divided by that of phi. slope @ x
    is the integral of phi * x' divided by that of phi, computed by parts without differencing x.
    """

    mean: csr_array
    slope: csr_array

    def __len__(self) -> int:
        return int(self.mean.shape[0])

    @property
    def first(self) -> Int[np.ndarray, " rows"]:
        """Number of the first sample of each row."""
        return self.mean.indices[self.mean.indptr[:-1]].astype(np.int64)

    @property
    def last(self) -> Int[np.ndarray, " rows"]:
        return self.mean.indices[self.mean.indptr[1:] - 1].astype(np.int64)

    @cached_property
    def width(self) -> int:
        """Largest distance between two rows whose windows overlap, plus one."""
        rows, first, last = np.arange(len(self)), self.first, self.last
        if (np.diff(first) >= 0).all():
            return int((np.searchsorted(first, last, side="right") - rows).max(initial=1))
        pairs = enumerate(zip(first, last, strict=True))
        apart = [rows[(first <= b) & (last >= a)].max() - k for k, (a, b) in pairs]
        return int(max(apart)) + 1

    def taken(self, rows: Bool[np.ndarray, " rows"] | Int[np.ndarray, " taken"]) -> Windows:
        """Some rows, by mask or by number."""
        if rows.dtype == np.bool_ and rows.all():
            return self
        return Windows(self.mean[rows], self.slope[rows])

    @staticmethod
    def joined(parts: Sequence[Windows]) -> Windows:
        """Windows over the samples of several records, one after the other."""
        if len(parts) == 1:
            return parts[0]
        means, slopes = [part.mean for part in parts], [part.slope for part in parts]
        return Windows(block_diag(means, format="csr"), block_diag(slopes, format="csr"))

    @staticmethod
    def even(
        first: Int[np.ndarray, " rows"],
        mean: Float[np.ndarray, "*rows samples"],
        slope: Float[np.ndarray, "*rows samples"],
        n_samples: int,
    ) -> Windows:
        """Windows of one length, with weights for each row, or the same for all."""
        n, length = len(first), mean.shape[-1]
        mean, slope = (np.broadcast_to(each, (n, length)).reshape(-1) for each in (mean, slope))
        return _windows(first, np.full(n, length), (mean, slope), n_samples)

    @staticmethod
    def of_matrices(mean: csr_array, slope: csr_array) -> Windows:
        """The same sums as these products, (rows, samples); columns must be sorted."""
        both = mean, slope
        first = np.minimum(*(m.indices[m.indptr[:-1]] for m in both)).astype(np.int64)
        last = np.maximum(*(m.indices[m.indptr[1:] - 1] for m in both)).astype(np.int64)
        starts = np.append(0, np.cumsum(last + 1 - first))
        weights = np.zeros((2, starts[-1]))  # zeros where a matrix has no entry
        for matrix, filled in zip(both, weights, strict=True):
            row = np.repeat(np.arange(len(first)), np.diff(matrix.indptr))
            filled[starts[row] + matrix.indices - first[row]] = matrix.data
        return _windows(first, last + 1 - first, weights, mean.shape[1])


def _windows(
    first: Int[np.ndarray, " rows"],
    lengths: Int[np.ndarray, " rows"],
    weights: Iterable[Float[np.ndarray, " weights"]],
    n_samples: int,
) -> Windows:
    """Windows from the first sample and the length of each row, and weights row after row."""
    starts = np.append(0, np.cumsum(lengths))
    places = np.arange(starts[-1]) + np.repeat(first - starts[:-1], lengths)
    shape = len(first), n_samples
    mean, slope = (csr_array((each, places, starts), shape=shape) for each in weights)
    return Windows(mean, slope)
