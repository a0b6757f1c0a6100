"""PySINDy 2.1 in the synthetic benchmark: the candidate supports of four of its methods.

Every derivative, library, weak integral and sparse regression is PySINDy's own. This module
sets them up, translates the supports to our names, and scores each by the R2 of its
least-squares refit on the method's own rows. The settings differ from PySINDy's defaults where
another choice found the truth more often in this benchmark:

- no ridge (default 0.05): on normalised columns it is as large as the smaller eigenvalues of
  the Gram matrix, and the Lorenz and Van der Pol truths are then almost never found;
- Savitzky-Golay windows of 25 samples (default 11), one choice for all systems and noises;
- weak domains of half-width 1/40 of the record (default 1/20).
"""

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float
from sklearn.exceptions import ConvergenceWarning

import ep2sindy as ep
from ep2sindy.data.numbers import zero_to_one
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.method import Finding
from ep2sindy.library.library import Library, polynomial
from ep2sindy.regression.searches import BestSubset, Unproven

try:
    import pysindy
except ImportError as error:
    raise ModuleNotFoundError('PySINDy is not there: pip install "ep2sindy[benchmark]"') from error

TINY = float(np.finfo(np.float64).tiny)

Candidates = dict[str, list[tuple[tuple[str, ...], float]]]


@dataclass(frozen=True, eq=False)
class SINDyRows:
    """The regression a method solves: x_dot = theta coef, columns of theta in library order.

    triangle: theta and x_dot reduced to terms + states rows by QR; the Gram matrix is unchanged.
    Column norms, least-squares coefficients and residuals are unchanged too, and so is every
    support that PySINDy selects. Only the time it takes shrinks.
    """

    theta: Float[np.ndarray, "rows terms"]
    x_dot: Float[np.ndarray, "rows states"]
    triangle: tuple[np.ndarray, np.ndarray] = field(init=False)

    def __post_init__(self) -> None:
        rows = np.concatenate([self.theta, self.x_dot], axis=1)
        whole = np.asarray(np.linalg.qr(rows, mode="r"))
        n_terms = self.theta.shape[1]
        object.__setattr__(self, "triangle", (whole[:, :n_terms], whole[:, n_terms:]))

    def thresholds(self, n: int, smallest: float) -> Float[np.ndarray, " n"]:
        """`n` thresholds, log-spaced from `smallest` to 1 of the largest normalised coefficient."""
        theta, x_dot = self.triangle
        full = np.linalg.lstsq(theta / np.linalg.norm(theta, axis=0), x_dot, rcond=None)[0]
        return np.abs(full).max() * np.geomspace(smallest, 1.0, n)

    def candidates(
        self,
        masks: Bool[np.ndarray, "models states terms"],
        library: Library,
        states: Sequence[str],
    ) -> Candidates:
        """Each distinct support but the empty one, smallest first, with the R2 of its refit."""
        theta, x_dot = self.triangle
        total = np.square(self.x_dot - self.x_dot.mean(axis=0)).sum(axis=0)
        found: Candidates = {}
        for k, state in enumerate(states):
            supports = {tuple(np.flatnonzero(mask).tolist()) for mask in masks[:, k]} - {()}
            found[state] = []
            for support in sorted(supports, key=lambda s: (len(s), s)):
                columns = theta[:, list(support)]
                coef = np.linalg.lstsq(columns, x_dot[:, k], rcond=None)[0]
                error = np.square(x_dot[:, k] - columns @ coef).sum()
                terms = tuple(library.names[j] for j in support)
                found[state].append((terms, float(1.0 - error / total[k])))
        return found


@ep.for_configs
@dataclass(frozen=True)
class PySINDySmoothing:
    """Savitzky-Golay smoothing, then second-order differences; theta holds the smoothed states.

    window: length in samples. order: order of the local polynomials.
    """

    window: int = 25
    order: int = 3

    def rows(
        self, runs: Sequence[Trajectory], library: Library, rng: np.random.Generator | None = None
    ) -> SINDyRows:
        theta, x_dot = [], []
        for run in runs:
            differentiation = pysindy.SmoothedFiniteDifference(
                smoother_kws={"window_length": self.window, "polyorder": self.order}
            )
            x_dot.append(np.asarray(differentiation(run.states, t=run.t)))
            features, order = pysindy_library(library, run.state_names)
            smoothed = np.asarray(differentiation.smoothed_x_)
            theta.append(np.asarray(features.fit_transform(smoothed))[:, order])
        return SINDyRows(np.concatenate(theta), np.concatenate(x_dot))


@ep.for_configs
@dataclass(frozen=True)
class PySINDyStlsq:
    """Sequentially thresholded least squares over a range of thresholds."""

    n_thresholds: int = 20
    smallest: float = 1e-3
    smoothing: PySINDySmoothing = PySINDySmoothing()

    def candidates(
        self, runs: Sequence[Trajectory], library: Library, *, rng: np.random.Generator
    ) -> Candidates:
        rows = self.smoothing.rows(runs, library)
        masks = threshold_masks(rows, rows.thresholds(self.n_thresholds, self.smallest))
        return rows.candidates(masks, library, runs[0].state_names)


@ep.for_configs
@dataclass(frozen=True)
class PySINDySsr:
    """Stepwise sparse regression: the smallest normalised coefficient is removed, one at a time."""

    smoothing: PySINDySmoothing = PySINDySmoothing()

    def candidates(
        self, runs: Sequence[Trajectory], library: Library, *, rng: np.random.Generator
    ) -> Candidates:
        rows = self.smoothing.rows(runs, library)
        search = pysindy.SSR(
            alpha=0.0, normalize_columns=True, max_iter=len(library), unbias=False
        ).fit(*rows.triangle)
        masks = np.array(search.history_) != 0.0
        return rows.candidates(masks, library, runs[0].state_names)


@ep.for_configs
@dataclass(frozen=True)
class PySINDyEnsemble:
    """Library bagging: STLSQ on `n_models` libraries with `n_dropped` random terms left out.

    For every threshold, the supports are the terms whose inclusion probability over the
    ensemble reaches each level that occurs.
    """

    n_models: int = 20
    n_dropped: int = 1
    n_thresholds: int = 12
    smallest: float = 3e-3
    smoothing: PySINDySmoothing = PySINDySmoothing()

    def candidates(
        self, runs: Sequence[Trajectory], library: Library, *, rng: np.random.Generator
    ) -> Candidates:
        rows = self.smoothing.rows(runs, library)
        masks = []
        for threshold in rows.thresholds(self.n_thresholds, self.smallest):
            ensemble = pysindy.EnsembleOptimizer(
                stlsq(threshold),
                library_ensemble=True,
                n_models=self.n_models,
                n_candidates_to_drop=self.n_dropped,
            )
            with expected_warnings(), legacy_random(rng):
                ensemble.fit(*rows.triangle)
            inclusion = (np.array(ensemble.coef_list) != 0.0).mean(axis=0)
            masks += [inclusion >= level for level in np.unique(inclusion[inclusion > 0.0])]
        return rows.candidates(np.array(masks), library, runs[0].state_names)


@ep.for_configs
@dataclass(frozen=True)
class PySINDyWeakForm:
    """Weak form on random domains of each run, with STLSQ over a range of thresholds.

    half_width: half the length of a domain, as a fraction of the run.
    """

    n_domains: int = 300
    half_width: float = 1 / 40
    n_thresholds: int = 20
    smallest: float = 1e-3

    def candidates(
        self, runs: Sequence[Trajectory], library: Library, *, rng: np.random.Generator
    ) -> Candidates:
        rows = self.rows(runs, library, rng)
        masks = threshold_masks(rows, rows.thresholds(self.n_thresholds, self.smallest))
        return rows.candidates(masks, library, runs[0].state_names)

    def rows(
        self, runs: Sequence[Trajectory], library: Library, rng: np.random.Generator
    ) -> SINDyRows:
        parts = [self._rows(run, library, rng) for run in runs]
        return SINDyRows(
            np.concatenate([part.theta for part in parts]),
            np.concatenate([part.x_dot for part in parts]),
        )

    def _rows(self, run: Trajectory, library: Library, rng: np.random.Generator) -> SINDyRows:
        # The bias must come from the inner library: the outer one's is not integrated against phi.
        features, order = pysindy_library(library, run.state_names)
        with legacy_random(rng):
            weak = pysindy.WeakPDELibrary(
                function_library=features,
                spatiotemporal_grid=run.t,
                K=self.n_domains,
                H_xt=[self.half_width * (run.t[-1] - run.t[0])],
            )
        states = pysindy.AxesArray(run.states, {"ax_time": 0, "ax_coord": 1})
        with expected_warnings():
            theta = np.asarray(weak.fit_transform(states))[:, order]
        return SINDyRows(theta, np.asarray(weak.convert_u_dot_integral(run.states)))


@ep.for_configs
@dataclass(frozen=True)
class PySINDySubsets:
    """The subsets of least residual on PySINDy's rows, one of each size up to `max_terms`.

    They are what its mixed-integer search MIOSR solves for, which needs a solver with a licence;
    the search is ours. A large library, whose proof would take too long, is searched by exchanges.
    """

    form: PySINDySmoothing | PySINDyWeakForm
    max_terms: int = 10

    def candidates(
        self, runs: Sequence[Trajectory], library: Library, *, rng: np.random.Generator
    ) -> Candidates:
        rows = self.form.rows(runs, library, rng)
        theta, x_dot = rows.triangle
        theta = theta / zero_to_one(np.linalg.norm(theta, axis=0))
        search, gram = BestSubset(self.max_terms), theta.T @ theta
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Unproven)  # an oracle needs candidates, no proof
            found = [search.supports(gram, theta.T @ y, float(y @ y)) for y in x_dot.T]
        # Every equation is offered those of the others, too, and keeps the best of each size.
        masks = np.repeat(np.concatenate(found)[:, None], x_dot.shape[1], axis=1)
        return rows.candidates(masks, library, runs[0].state_names)


@ep.for_configs
@dataclass(frozen=True)
class PySINDyVariant:
    """A method of PySINDy in our benchmark; it gives candidates, and the user would have to choose.

    kept: for every state the best support of each size by R2, and the empty one. aicc: if True, the
    user chooses by the corrected Akaike criterion of the residuals on the method's rows, one per
    sample; if False, nothing is selected.
    """

    method: PySINDyStlsq | PySINDySsr | PySINDyEnsemble | PySINDyWeakForm | PySINDySubsets
    aicc: bool = False

    def find(
        self, runs: Sequence[Trajectory], library: Library, *, rng: np.random.Generator
    ) -> Finding:
        found = self.method.candidates(runs, library, rng=rng)
        n = sum(run.n_samples for run in runs)
        return Finding(
            kept={state: best_of_each_size(several) for state, several in found.items()},
            selected={state: least_aicc(several, n) for state, several in found.items()}
            if self.aicc
            else None,
        )


@ep.for_configs
@dataclass(frozen=True)
class PySINDyAsItComes:
    """`pysindy.SINDy` with its own defaults, but for the degree of the library.

    That is second-order differences of the raw samples, and STLSQ with threshold 0.1.
    """

    def find(
        self, runs: Sequence[Trajectory], library: Library, *, rng: np.random.Generator
    ) -> Finding:
        features, order = pysindy_library(library, runs[0].state_names)
        model = pysindy.SINDy(feature_library=features)
        with expected_warnings():
            model.fit([run.states for run in runs], t=[run.t for run in runs])
        used = np.asarray(model.coefficients())[:, order] != 0.0
        names = np.array(library.names)
        chosen = {
            state: frozenset(names[mask].tolist())
            for state, mask in zip(runs[0].state_names, used, strict=True)
        }
        return Finding(kept={state: [each] for state, each in chosen.items()}, selected=chosen)


def least_aicc(candidates: Sequence[tuple[tuple[str, ...], float]], n_rows: int) -> frozenset[str]:
    """The support of least AICc (Hurvich & Tsai 1989, doi:10.1093/biomet/76.2.297)."""

    def aicc(candidate: tuple[tuple[str, ...], float]) -> float:
        terms, r2 = candidate
        k = len(terms) + 1  # with the variance
        return n_rows * np.log(max(1.0 - r2, TINY)) + 2.0 * k * n_rows / (n_rows - k - 1.0)

    return frozenset(min([((), 0.0), *candidates], key=aicc)[0])


def best_of_each_size(
    candidates: Sequence[tuple[tuple[str, ...], float]],
) -> list[frozenset[str]]:
    """The support of highest R2 of every size, after the empty support."""
    ranked = sorted(candidates, key=lambda c: c[1])
    best = {len(terms): frozenset(terms) for terms, _ in ranked}
    return [frozenset(), *(best[size] for size in sorted(best))]


def pysindy_library(
    library: Library, states: Sequence[str]
) -> tuple[pysindy.PolynomialLibrary, list[int]]:
    """PySINDy's library of the same terms, and the index of each of our terms in it.

    Raises ValueError unless `library` holds every product of the states up to its degree.
    """
    degree = int(library.exponents.sum(axis=1).max())
    whole = polynomial(states, degree=degree)
    if library.variables != tuple(states) or set(library.names) != set(whole.names):
        raise ValueError(
            f"PySINDy needs the whole polynomial library of the states {list(states)} up to "
            f"degree {degree}, got {list(library.names)}"
        )
    features = pysindy.PolynomialLibrary(degree=degree).fit(np.zeros((2, len(states))))
    place = {tuple(powers): j for j, powers in enumerate(features.powers_.tolist())}
    return features, [place[tuple(powers)] for powers in library.exponents.tolist()]


def stlsq(threshold: float) -> pysindy.STLSQ:
    # Without a ridge the last fit of STLSQ is least squares already: nothing to unbias.
    return pysindy.STLSQ(threshold=threshold, alpha=0.0, normalize_columns=True, unbias=False)


def threshold_masks(
    rows: SINDyRows, thresholds: Float[np.ndarray, " n"]
) -> Bool[np.ndarray, "n states terms"]:
    """Supports of STLSQ at every threshold, the same for all equations."""
    with expected_warnings():
        fits = [stlsq(threshold).fit(*rows.triangle) for threshold in thresholds]
    return np.array([fit.coef_ != 0.0 for fit in fits])


@contextmanager
def expected_warnings() -> Iterator[None]:
    """Silence two expected warnings: thresholds that empty an equation, weak-library indexing."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Sparsity parameter is too big", UserWarning)
        warnings.filterwarnings("ignore", "STLSQ did not converge", ConvergenceWarning)
        # PySINDy's AxesWarning, which it does not export.
        warnings.filterwarnings("ignore", "2 axes labeled for array", SyntaxWarning)
        yield


@contextmanager
def legacy_random(rng: np.random.Generator) -> Iterator[None]:
    """Make PySINDy, which uses NumPy's global state, draw from `rng`; restore it afterwards."""
    state = np.random.get_state()  # noqa: NPY002
    np.random.seed(rng.integers(2**32, dtype=np.uint32))  # noqa: NPY002
    try:
        yield
    finally:
        np.random.set_state(state)  # noqa: NPY002
