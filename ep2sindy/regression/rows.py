"""Regression problem target = theta coef: rows, their split, and Gram matrices."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int

from ep2sindy.data.numbers import column_norms
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import Library
from ep2sindy.regression.windows import Windows
from ep2sindy.runtime.values import locked, read_only
from ep2sindy.trust.memory import check_memory

# Rows of a regression, training and held-out, beyond which scaled copies are made block by block.
MOST_ROWS = 262_144

SMALL = 1e-200  # a sum of squares from it to its inverse has lost nothing to the number format

ROW_BLOCK = 512  # rows whose pair products are held at once, few enough to fit in the cache


@dataclass(frozen=True, eq=False)
class Grams:
    """Sums of products of scaled columns over some rows, all that least squares needs of them.

    xx: of the terms, xy: of the terms and the target of each equation, yy: squares of the targets.
    """

    xx: Float[np.ndarray, "terms terms"]
    xy: Float[np.ndarray, "equations terms"]
    yy: Float[np.ndarray, " equations"]


@dataclass(frozen=True, eq=False)
class NoisyRows:
    """Dependence of the training rows of one equation on the noisy samples x.

    Targets are windows.slope @ x[state], terms are windows.mean @ library(x). target: of the
    samples as they are. values: (samples, variables), the library's variables, then states that it
    lacks.
    smoothed: an estimate of their true values. noise_std: standard deviation of their independent
    noise.
    """

    windows: Windows
    target: Float[np.ndarray, " rows"]
    state: int
    values: Float[np.ndarray, "samples variables"]
    smoothed: Float[np.ndarray, "samples variables"]
    noise_std: Float[np.ndarray, "samples variables"]

    @cached_property
    def columns(self) -> tuple[Float[np.ndarray, "variables samples"], ...]:
        """Values, smoothed values and noise, each variable contiguous in memory."""
        return tuple(map(np.ascontiguousarray, (self.values.T, self.smoothed.T, self.noise_std.T)))


@dataclass(frozen=True, eq=False)
class TermsAt:
    """Terms of a library at (rows, variables) values, evaluated for the rows that are asked for.

    For long records, whose terms take several times the memory of their samples.
    """

    library: Library
    values: Float[np.ndarray, "rows variables"]

    def __len__(self) -> int:
        return len(self.values)

    def __getitem__(self, rows: Any) -> Float[np.ndarray, "_ terms"]:
        with np.errstate(over="ignore"):  # RegressionRows names a term that is not finite
            return locked(np.ascontiguousarray(self.library.evaluate(self.values[rows])))


@dataclass(frozen=True, eq=False)
class RegressionRows:
    """Rows of library terms and targets, in SI units, ready for a search.

    theta: (rows, terms). target: (rows, equations).
    groups: (rows,), group numbers; rows that share samples belong to one group, and stay together
    in a split or a bootstrap. test: (rows,), true for held-out rows.
    trajectories: source of the rows; draws of neighbours never cross from one to the next.
    noisy: dependence of the training rows on noisy samples, if known; then there is one equation.
    Raises ValueError for values that are not finite or fewer training rows than terms.
    """

    theta: Float[np.ndarray, "rows terms"] | TermsAt
    target: Float[np.ndarray, "rows equations"]
    library: Library
    equations: Sequence[str]
    groups: Int[np.ndarray, " rows"]
    test: Bool[np.ndarray, " rows"]
    trajectories: Sequence[Trajectory] = ()
    noisy: NoisyRows | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.theta, TermsAt):
            object.__setattr__(self, "theta", read_only(self.theta))
        object.__setattr__(self, "target", read_only(self.target))
        object.__setattr__(self, "equations", tuple(self.equations))
        rates = [f"d({e})/dt" for e in self.equations]
        for names, values in ((self.library.names, self.theta), (rates, self.target)):
            for start in range(0, len(values), MOST_ROWS):
                finite = np.isfinite(values[start : start + MOST_ROWS])
                if not finite.all():
                    row, column = np.argwhere(~finite)[0]
                    raise ValueError(
                        f"every term must be finite on every row: {names[column]!r} is not on row "
                        f"{start + row}; lower the degree or rescale the variables"
                    )
        n_train = int((~self.test).sum())
        if n_train < len(self.library):
            raise ValueError(
                f"a library of {len(self.library)} terms needs at least as many training rows: "
                f"{n_train} of {len(self.theta)} rows are for training; use a smaller library "
                "or more data"
            )

    @cached_property
    def theta_scale(self) -> Float[np.ndarray, " terms"]:
        """L2 norm of each column over the training rows; 1 for a column of zeros."""
        return _norms(self.theta, ~self.test)

    @cached_property
    def target_scale(self) -> Float[np.ndarray, " equations"]:
        return _norms(self.target, ~self.test)

    @cached_property
    def train_columns(self) -> Float[np.ndarray, "columns train"]:
        """Scaled terms, then scaled targets, of the training rows, each contiguous in memory."""
        return self._scaled(~self.test)

    @cached_property
    def test_columns(self) -> Float[np.ndarray, "columns test"]:
        return self._scaled(self.test)

    @property
    def n_train(self) -> int:
        return len(self.test) - int(np.count_nonzero(self.test))

    def blocks(self, *, test: bool) -> Iterator[Float[np.ndarray, "columns _"]]:
        """Scaled columns, of training or held-out rows in order: of all at once, or of a long
        record in blocks, of which none is kept.
        """
        if len(self.test) <= MOST_ROWS:
            yield self.test_columns if test else self.train_columns
            return
        for start in range(0, len(self.test), MOST_ROWS):
            yield self._scaled(self.test[start : start + MOST_ROWS] == test, start)

    @property
    def train_theta(self) -> Float[np.ndarray, "train terms"]:
        return self.train_columns[: len(self.library)].T

    def scaled_target(self, equation: int, *, test: bool = False) -> Float[np.ndarray, " _"]:
        """Scaled target of an equation on the training rows, or on held-out ones."""
        return self.target[self.test == test, equation] / self.target_scale[equation]

    def coef_scale(self, equation: int) -> Float[np.ndarray, " terms"]:
        """Factors that convert coefficients of scaled columns to SI."""
        return self.target_scale[equation] / self.theta_scale

    @cached_property
    def train_products(self) -> Float[np.ndarray, "columns columns"]:
        """Products of all scaled columns, summed over the training rows."""
        return self._products(test=False)

    @cached_property
    def train_gram(self) -> Grams:
        return self._grams(self.train_products)

    @cached_property
    def test_gram(self) -> Grams:
        return self._grams(self._products(test=True))

    def check_grams(self, n_draws: int) -> None:
        """Raise ValueError if the Gram matrices of `n_draws` draws exceed the memory."""
        n_columns = len(self.library) + len(self.equations)
        each = 8.0 * 5.0 * n_columns**2  # the whole matrix and its scaled copies
        products_of_rows = 3.0 * 4.0 * n_columns**2 * min(ROW_BLOCK, self.n_train)
        check_memory(
            each * n_draws + products_of_rows,
            f"Gram matrices of {len(self.library)} terms in {n_draws} bootstraps",
            hint="lower bootstraps.n, take fewer terms, or a lower degree",
            each=each,
        )

    def resampled_products(
        self, weights: Float[np.ndarray, "draws train"]
    ) -> Float[np.ndarray, "draws columns columns"]:
        """Products of all scaled columns, summed over the training rows for each draw.

        Each row is counted `weights` times. All draws share the products of a row, so each draw is
        one row of a matrix product. Rows are processed in blocks to keep these products small.
        """
        n = len(self.library) + len(self.equations)
        (left, right), begin = np.triu_indices(n), 0
        sums, products = np.zeros((len(weights), len(left))), np.empty((len(weights), n, n))
        for columns in self.blocks(test=False):
            for start in range(0, columns.shape[1], ROW_BLOCK):
                some = columns[:, start : start + ROW_BLOCK]
                here = slice(begin + start, begin + start + some.shape[1])
                sums += weights[:, here] @ (some[left] * some[right]).T
            begin += columns.shape[1]
        products[:, left, right] = products[:, right, left] = sums
        return products

    def _products(self, *, test: bool) -> Float[np.ndarray, "columns columns"]:
        parts = [columns @ columns.T for columns in self.blocks(test=test)]
        return sum(parts[1:], parts[0])

    def _grams(self, products: Float[np.ndarray, "columns columns"]) -> Grams:
        n = len(self.library)
        return Grams(
            xx=products[:n, :n].copy(),  # views would be compiled for anew
            xy=products[n:, :n].copy(),
            yy=products.diagonal()[n:],
        )

    def _scaled(
        self, chosen: Bool[np.ndarray, " rows"], start: int = 0
    ) -> Float[np.ndarray, "columns _"]:
        """Scaled columns of the rows that are chosen among those from `start` on."""
        n, rows = len(self.library), slice(start, start + len(chosen))
        scaled = np.empty((n + len(self.equations), np.count_nonzero(chosen)))
        np.divide(self.theta[rows][chosen].T, self.theta_scale[:, None], out=scaled[:n])
        np.divide(self.target[rows][chosen].T, self.target_scale[:, None], out=scaled[n:])
        return scaled


def _norms(
    values: Float[np.ndarray, "rows columns"] | TermsAt, chosen: Bool[np.ndarray, " rows"]
) -> Float[np.ndarray, " columns"]:
    """L2 norms of the columns over some rows, as `column_norms`, without a copy of them all."""
    squares = np.zeros(values[:0].shape[1])
    for start in range(0, len(chosen), MOST_ROWS):
        here = slice(start, start + MOST_ROWS)
        part = values[here][chosen[here]]
        squares += np.einsum("rc,rc->c", part, part)
    if ((squares > SMALL) & (squares < 1.0 / SMALL)).all():
        return np.sqrt(squares)
    return column_norms(values[chosen])


@runtime_checkable
class Formulation(Protocol):
    """Turns trajectories into regressions: one, or one per equation if rows differ."""

    def assemble(
        self, trajectories: Sequence[Trajectory], library: Library, *, rng: np.random.Generator
    ) -> tuple[RegressionRows, ...]: ...
