"""The adaptive lasso as a scikit-learn regressor, for use in other tools such as PySINDy.

scikit-learn requires a class that inherits, and that must be fitted before it predicts. The rest
of the package avoids both, so such classes are confined to this module. There is no intercept,
since a library of terms contains the constant itself.

In PySINDy: SINDy(optimizer=WrappedOptimizer(AdaptiveLassoRegressor(), unbias=False)). The
coefficients are least-squares values already. Unbiasing them again would drop coefficients
below 1e-14, such as the rate coefficients of a plasma in SI.
"""

from __future__ import annotations

from typing import Any, no_type_check

import numpy as np
from jaxtyping import Bool, Float
from sklearn.base import BaseEstimator, MultiOutputMixin, RegressorMixin
from sklearn.utils.validation import check_is_fitted, validate_data

from ep2sindy.data.numbers import column_norms
from ep2sindy.regression.gram_kernels import explained_squares, fit_masks
from ep2sindy.regression.searches import AdaptiveLasso


class AdaptiveLassoRegressor(MultiOutputMixin, RegressorMixin, BaseEstimator):
    """Least-squares fit of the support with the lowest BIC on the adaptive-lasso path.

    BIC = n_rows log(residual) + n_terms log(n_rows), where the residual is a share of the sum
    of the target's squares. The support does not depend on the units of columns or target.
    gamma, max_terms: as in `AdaptiveLasso`.
    tolerance: a residual below it counts as equal to it. The error of differentiation is not
    white noise, and without a lower bound BIC would use the whole library to explain it.
    Attributes after `fit`: coef_, and its mask support_; (terms,) for y of (rows,), otherwise
    (targets, terms).
    Source of the criterion: Schwarz 1978, doi:10.1214/aos/1176344136.
    """

    gamma: float
    max_terms: int | None
    tolerance: float

    @no_type_check  # rule of scikit-learn: the constructor stores any value, and `fit` checks it
    def __init__(
        self, *, gamma: float = 1.0, max_terms: int | None = None, tolerance: float = 1e-4
    ) -> None:
        self.gamma = gamma
        self.max_terms = max_terms
        self.tolerance = tolerance

    def fit(self, X: Any, y: Any) -> AdaptiveLassoRegressor:
        """Choose and fit a support for each target.

        X: (rows, terms). y: (rows,) or (rows, targets).
        """
        search = AdaptiveLasso(gamma=self.gamma, max_terms=self.max_terms)
        if not 0.0 < self.tolerance < 1.0:
            raise ValueError(f"tolerance must lie in (0, 1): {self.tolerance} came")
        X, y = validate_data(self, X, y, dtype=np.float64, y_numeric=True, multi_output=True)
        targets = y.astype(np.float64).reshape(len(y), -1)
        term_norms, target_norms = column_norms(X), column_norms(targets)
        columns, targets = X / term_norms, targets / target_norms
        xx, xy = columns.T @ columns, targets.T @ columns
        support = np.array([self._choose(search, xx, products, len(X)) for products in xy])
        coef = np.zeros(support.shape)
        for mask, row, target in zip(support, coef, targets.T, strict=True):
            # Solved on the rows, since the Gram matrix squares their condition number.
            row[mask] = np.linalg.lstsq(columns[:, mask], target, rcond=None)[0]
        coef *= target_norms[:, None] / term_norms
        self.coef_ = coef if y.ndim == 2 else coef[0]
        self.support_ = support if y.ndim == 2 else support[0]
        self.intercept_ = 0.0
        return self

    def predict(self, X: Any) -> np.ndarray:
        """Predict the targets for X (rows, terms); returns (rows,) or (rows, targets), like y."""
        check_is_fitted(self)
        X = validate_data(self, X, dtype=np.float64, reset=False)
        return X @ self.coef_.T

    def _choose(
        self, search: AdaptiveLasso, xx: np.ndarray, xy: np.ndarray, n_rows: int
    ) -> np.ndarray:
        """Support of lowest BIC, from Gram matrices of columns and a target of unit norm."""
        masks = search.supports(xx, xy, 1.0)
        residual = np.maximum(_residual_shares(xx, xy, masks), self.tolerance)
        bic = n_rows * np.log(residual) + masks.sum(axis=1) * np.log(n_rows)
        return masks[np.nanargmin(bic)]


def _residual_shares(
    xx: Float[np.ndarray, "terms terms"],
    xy: Float[np.ndarray, " terms"],
    masks: Bool[np.ndarray, "supports terms"],
) -> Float[np.ndarray, " supports"]:
    """Least-squares residual, squared, of a target of norm 1; NaN for dependent terms."""
    return 1.0 - explained_squares(fit_masks(xx, xy, masks), xx, xy)
