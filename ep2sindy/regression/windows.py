"""Windows of weak rows: weighted sums over short stretches of neighbouring samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_array

from ep2sindy.regression.window_kernels import band_width, sum_windows


@dataclass(frozen=True, eq=False)
class Windows:
    """Test functions phi on stretches of neighbouring samples, one for every row.

    The stretch of row i begins at sample first[i]; its weights are mean[starts[i]:starts[i + 1]],
    and slope in the same places. The sum of mean times values is the integral of phi * values
    divided by that of phi. That of slope times x is the integral of phi * x' divided by that of
    phi, computed by parts without differencing x.
    """

    starts: Int[np.ndarray, " bounds"]
    first: Int[np.ndarray, " rows"]
    mean: Float[np.ndarray, " weights"]
    slope: Float[np.ndarray, " weights"]
    n_samples: int

    def __len__(self) -> int:
        return len(self.first)

    @property
    def last(self) -> Int[np.ndarray, " rows"]:
        return self.first + np.diff(self.starts) - 1

    @cached_property
    def width(self) -> int:
        """Largest distance between two rows whose windows overlap, plus one."""
        return int(band_width(self.first, self.last))

    def means(self, values: Float[np.ndarray, "samples ..."]) -> Float[np.ndarray, "rows ..."]:
        """Means of sampled values over all windows."""
        return self._sums(self.mean, values)

    def slopes(self, values: Float[np.ndarray, "samples ..."]) -> Float[np.ndarray, "rows ..."]:
        """Mean derivatives of sampled values over all windows."""
        return self._sums(self.slope, values)

    def _sums(self, weights: np.ndarray, values: np.ndarray) -> np.ndarray:
        columns = np.ascontiguousarray(np.atleast_2d(values.T))
        sums = np.empty((len(columns), len(self)))
        sum_windows(self.starts, self.first, weights, columns, sums)
        return sums.T if values.ndim == 2 else sums[0]

    def taken(self, rows: Bool[np.ndarray, " rows"] | Int[np.ndarray, " taken"]) -> Windows:
        """Some rows, by mask or by number."""
        if rows.dtype == np.bool_ and rows.all():
            return self
        lengths = np.diff(self.starts)[rows]
        starts = np.append(0, np.cumsum(lengths))
        places = np.arange(starts[-1]) + np.repeat(self.starts[:-1][rows] - starts[:-1], lengths)
        mean, slope = self.mean[places], self.slope[places]
        return Windows(starts, self.first[rows], mean, slope, self.n_samples)

    def matrices(self) -> tuple[csr_array, csr_array]:
        """The weights of means and of slopes as sparse matrices (rows, samples)."""
        columns = np.arange(self.starts[-1]) + np.repeat(
            self.first - self.starts[:-1], np.diff(self.starts)
        )
        shape = len(self), self.n_samples
        parts = ((weights, columns, self.starts) for weights in (self.mean, self.slope))
        return tuple(csr_array(part, shape=shape) for part in parts)

    @staticmethod
    def joined(parts: Sequence[Windows]) -> Windows:
        """Windows over the samples of several records, one after the other."""
        if len(parts) == 1:
            return parts[0]
        lengths = np.concatenate([np.diff(part.starts) for part in parts])
        samples = np.cumsum([0, *(part.n_samples for part in parts)]).tolist()
        return Windows(
            np.append(0, np.cumsum(lengths)),
            np.concatenate([part.first + n for part, n in zip(parts, samples[:-1], strict=True)]),
            np.concatenate([part.mean for part in parts]),
            np.concatenate([part.slope for part in parts]),
            samples[-1],
        )

    @staticmethod
    def even(
        first: Int[np.ndarray, " rows"],
        mean: Float[np.ndarray, "*rows samples"],
        slope: Float[np.ndarray, "*rows samples"],
        n_samples: int,
    ) -> Windows:
        """Windows of one length, with weights for each row, or the same for all."""
        shape = len(first), mean.shape[-1]
        starts = np.arange(0, shape[0] * shape[1] + 1, shape[1])
        mean, slope = (np.broadcast_to(each, shape).reshape(-1) for each in (mean, slope))
        return Windows(starts, first, mean, slope, n_samples)

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
        return Windows(starts, first, weights[0], weights[1], mean.shape[1])
