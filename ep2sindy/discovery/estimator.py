"""The whole search as a scikit-learn estimator, for grids of settings and cross-validation.

scikit-learn requires a class that inherits, and that must be fitted before it predicts; the rest of
the package avoids both.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, no_type_check

import numpy as np
from jaxtyping import Float
from sklearn.base import BaseEstimator
from sklearn.utils.validation import check_is_fitted, validate_data

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.discover import discover
from ep2sindy.library.library import polynomial

if TYPE_CHECKING:
    from ep2sindy.discovery.result import Discovery, DiscoveryMethod
    from ep2sindy.library.library import Library
    from ep2sindy.model.model import SparseModel


class SINDy(BaseEstimator):
    """Equations x' = f(x, u) found in samples, with the methods of a scikit-learn estimator.

    In `fit` and `score`, times t take the place of y. Folds must keep them in order, as KFold() and
    TimeSeriesSplit() do.

    Parameters
    ----------
    degree : int, default 2
        Degree of the library, as for `ep.polynomial`.
    functions : sequence of str, default ()
        Functions of the library, as for `ep.polynomial`.
    library : Library, optional
        A library over the names of the features, in place of degree and functions.
    method : DiscoveryMethod, optional
        None takes `TrajectorySearch()`, as for `ep.discover`.
    seed : int, default 0
        Of the search.

    Attributes
    ----------
    model_ : SparseModel
        The equations, after `fit`.
    discovery_ : Discovery
        The whole result, after `fit`.
    input_names_ : tuple of str
        Names of the columns of u, after `fit`.
    n_features_in_ : int
        Number of columns of X, after `fit`.
    feature_names_in_ : array
        Names of the columns, after `fit` on a DataFrame.

    Examples
    --------
    >>> run = ep.lotka_volterra().trajectory(noise=0.02, rng=0)
    >>> found = ep.discovery.SINDy(degree=2).fit(run.states, run.t)
    >>> list(found.model_.terms("x0"))
    ['x0', 'x0*x1']
    >>> found.predict(run.states).shape
    (1000, 2)
    """

    degree: int
    functions: Sequence[str]
    library: Library | None
    method: DiscoveryMethod | None
    seed: int
    discovery_: Discovery
    model_: SparseModel
    input_names_: tuple[str, ...]

    @no_type_check  # rule of scikit-learn: the constructor stores any value, and `fit` checks it
    def __init__(
        self,
        *,
        degree: int = 2,
        functions: Sequence[str] = (),
        library: Library | None = None,
        method: DiscoveryMethod | None = None,
        seed: int = 0,
    ) -> None:
        self.degree = degree
        self.functions = functions
        self.library = library
        self.method = method
        self.seed = seed

    def fit(
        self, X: Any, t: Any, *, u: Any = None, feature_names: Sequence[str] | None = None
    ) -> SINDy:
        """Find the equations of all trajectories.

        Parameters
        ----------
        X : array or DataFrame (samples, n_states), or list of these
            Samples of one trajectory, or a list with one entry per trajectory. The columns of a
            DataFrame give the names.
        t : (samples,) array or float, or list of these
            Times in s, increasing, or a time step in s. For several trajectories a list, or one for
            all.
        u : (samples, n_inputs) array, or list of these, optional
            Samples of the inputs.
        feature_names : sequence of str, optional
            Names of the states, then of the inputs. None takes x0, x1, ... and u0, u1, ...

        Returns
        -------
        SINDy
            This estimator, fitted.

        Raises
        ------
        ValueError
            If samples have no times, or `ep.discover` refuses them.
        """
        runs = self._runs(X, t, u, feature_names, reset=True)
        library = self.library
        if library is None:
            library = polynomial(runs[0].names, degree=self.degree, functions=self.functions)
        self.discovery_ = discover(runs, library, self.method, seed=self.seed)
        self.model_ = self.discovery_.model
        self.input_names_ = tuple(runs[0].input_names)
        return self

    def predict(self, X: Any, u: Any = None) -> Any:
        """Derivative of the states, (samples, n_states) in SI per second; of a list, a list."""
        check_is_fitted(self)
        if _are_several(X):
            inputs = [None] * len(X) if u is None else u
            return [self.predict(*pair) for pair in zip(X, inputs, strict=True)]
        states = validate_data(self, X, reset=False, dtype=np.float64)
        return self.model_.predict(states, self._inputs(u))

    def score(self, X: Any, t: Any, *, u: Any = None) -> float:
        """R2 of forecasts over one step, averaged over states, from samples of all trajectories.

        An exact law of clean samples has 1, and noise keeps it below (`SparseModel.score`).
        X, t, u: as for `fit`.
        """
        check_is_fitted(self)
        names = (*self.model_.states, *self.input_names_)
        runs = self._runs(X, t, u, names, reset=False)
        return self.model_.score(runs)

    def simulate(self, x0: Any, t: Any, u: Any = None) -> Float[np.ndarray, "samples n_states"]:
        """States at the times t, in s, from x0 at t[0]; NaN from where the run has diverged.

        u: (samples, n_inputs) at these times. `model_.simulate` says how a run ended.
        """
        check_is_fitted(self)
        run = self.model_.simulate(t, x0, self._inputs(u))
        states = np.full((np.size(t), len(run.state_names)), np.nan)
        states[: len(run.states)] = run.states
        return states

    def get_feature_names_out(self, input_features: Any = None) -> np.ndarray:
        """Names of the terms of the library, in the order of the rows of `model_.coef`.

        input_features: None, or the names of the features of `fit`.
        """
        check_is_fitted(self)
        known = list(self.model_.states)
        if input_features is not None and list(input_features) != known:
            raise ValueError(
                f"input_features should match those of fit, {known}, got {list(input_features)}"
            )
        return np.array(self.model_.library.names, dtype=object)

    def _inputs(self, u: Any) -> Float[np.ndarray, "samples n_inputs"] | None:
        """The columns of u that the library takes, in its order."""
        if u is None:
            return None
        columns = _columns(u)
        if columns.shape[1] != len(self.input_names_):
            raise ValueError(
                f"u must have a column for each of {list(self.input_names_)}, as in fit, got shape "
                f"{columns.shape}"
            )
        return columns[:, [self.input_names_.index(name) for name in self.model_.inputs]]

    def _runs(
        self, X: Any, t: Any, u: Any, names: Sequence[str] | None, *, reset: bool
    ) -> list[Trajectory]:
        """Trajectories of the samples. reset: the first of them sets the features."""
        several = _are_several(X)
        parts = X if several else [X]
        times = t if several and isinstance(t, list | tuple) else [t] * len(parts)
        inputs = [None] * len(parts) if u is None else u if several else [u]
        if not len(parts) == len(times) == len(inputs):
            raise ValueError(
                f"each of {len(parts)} trajectories needs its times and its inputs, got lists of "
                f"{len(times)} and {len(inputs)}"
            )
        found = []
        for k, (part, at, drive) in enumerate(zip(parts, times, inputs, strict=True)):
            first = reset and k == 0
            states = validate_data(self, part, reset=first, dtype=np.float64, ensure_min_samples=2)
            if names is None and "feature_names_in_" in vars(self):
                names = self.feature_names_in_.tolist()
            found.append(_trajectory(states, at, drive, names))
        return found


def _are_several(X: Any) -> bool:
    """True for a list of tables or arrays of two dimensions, one for each trajectory."""
    return isinstance(X, list | tuple) and len(X) > 0 and all(np.ndim(part) == 2 for part in X)


def _trajectory(
    states: Float[np.ndarray, "samples n_states"], t: Any, u: Any, names: Sequence[str] | None
) -> Trajectory:
    if t is None:
        raise ValueError(
            "requires y to be passed, but the target y is None: y are the times here, in s, as in "
            "fit(X, t)"
        )
    n_samples, n_states = states.shape
    inputs = np.empty((n_samples, 0)) if u is None else _columns(u)
    names = [f"x{k}" for k in range(n_states)] if names is None else list(names)
    if len(names) == n_states:
        names += [f"u{k}" for k in range(inputs.shape[1])]
    times = t * np.arange(n_samples) if np.ndim(t) == 0 else np.asarray(t)
    return Trajectory(times, states, names[:n_states], inputs, names[n_states:])


def _columns(u: Any) -> Float[np.ndarray, "samples n_inputs"]:
    """Samples of inputs as a matrix, also those of a single one."""
    values = np.asarray(u, dtype=np.float64)
    return values[:, None] if values.ndim == 1 else values
