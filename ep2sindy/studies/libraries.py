"""Several libraries on the same data: what each finds, and how its model runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import compress

import numpy as np
import pandas as pd
from jaxtyping import Float

from ep2sindy.ambiguity import usable_terms
from ep2sindy.bootstraps import Bootstraps
from ep2sindy.discover import Discovery, discover
from ep2sindy.library import Library
from ep2sindy.model import Rollout, SparseModel, assemble_model, equation_text
from ep2sindy.pareto import Candidate, ParetoFront, fit_support
from ep2sindy.regression import Formulation
from ep2sindy.search import Search
from ep2sindy.selection import Selection, selected
from ep2sindy.spectrum import dominant_frequency
from ep2sindy.trajectory import Trajectory


@dataclass(frozen=True)
class LibraryCase:
    """One library, the rule that selects from its fronts, and published equations if any.

    published: state -> term -> SI coefficient; where the library has its terms, and the data can
    tell them from others, they are fitted as well.
    """

    library: Library
    selection: Selection
    published: Mapping[str, Mapping[str, float]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Integrated:
    """A model, its run over the first samples of the data, and how far it strays.

    frequency_Hz: dominant frequency of each state of the rollout; NaN where it diverged, or where
    the state died out: less than a tenth of the data's spread in the second half.
    nrmse: root mean square error over the rollout, in standard deviations of the data, RMS
    over the states; NaN where it diverged. A constant at the mean scores 1.
    """

    model: SparseModel
    rollout: Rollout
    frequency_Hz: Mapping[str, float]
    nrmse: float

    @property
    def verdict(self) -> str:
        """One word or two on the trajectory."""
        if self.rollout.diverged:
            return f"diverges at {self.rollout.t[-1]:.3g} s"
        if np.isnan(list(self.frequency_Hz.values())).any():
            return "dies out"
        return "oscillates" if self.nrmse >= 1.0 else "follows the data"


@dataclass(frozen=True, eq=False)
class LibraryResult:
    """One library's discovery and its selected model; the published terms, fitted to our data."""

    case: LibraryCase
    discovery: Discovery
    selected: Integrated
    refitted: Mapping[str, Candidate]
    published: Integrated | None


def compare_libraries(
    run: Trajectory,
    cases: Mapping[str, LibraryCase],
    *,
    formulation: Formulation,
    search: Search,
    bootstraps: Bootstraps,
    rollout_s: float | None,
    depth: int = 1,
    rng: np.random.Generator,
) -> dict[str, LibraryResult]:
    """Discover a model with every library and integrate it from the first sample.

    Each case draws from its own stream, so that adding a case changes no other.
    rollout_s: how far to integrate; None, or more than there is, means to the data's end.
    depth: candidates kept per size.
    """
    n_samples = run.n_samples if rollout_s is None else samples_in(run, rollout_s)
    results = {}
    for (name, case), stream in zip(cases.items(), rng.spawn(len(cases)), strict=True):
        discovery = discover(
            [run],
            case.library,
            formulation=formulation,
            search=search,
            bootstraps=bootstraps,
            selection=case.selection,
            depth=depth,
            rng=stream,
        )
        refitted = _refitted(discovery, case.published)
        results[name] = LibraryResult(
            case=case,
            discovery=discovery,
            selected=integrate(discovery.model, run, n_samples),
            refitted=refitted,
            published=_integrate_refitted(discovery, refitted, run, n_samples),
        )
    return results


def _refitted(
    discovery: Discovery, published: Mapping[str, Mapping[str, float]]
) -> dict[str, Candidate]:
    """Published terms fitted to our rows, where the data can tell them from others."""
    found = {}
    for state, terms in published.items():
        if state in discovery.fronts:
            problem = discovery.fronts[state].problem
            at_hand = set(compress(problem.term_names, usable_terms(problem)))
            if set(terms) <= at_hand:
                found[state] = fit_support(problem, state, list(terms))
    return found


def integrate(
    model: SparseModel,
    run: Trajectory,
    n_samples: int,
    *,
    initial: Float[np.ndarray, " n_states"] | None = None,
) -> Integrated:
    """Run a model over the first samples of the data, and compare.

    initial: the state to start from, in SI; None takes the data's.
    """
    rollout = model.rollout(run, n_samples=n_samples, initial=initial)
    return Integrated(model, rollout, _frequencies(model, rollout, run), _nrmse(rollout, run))


def _integrate_refitted(
    discovery: Discovery, refitted: Mapping[str, Candidate], run: Trajectory, n_samples: int
) -> Integrated | None:
    if set(refitted) != set(run.state_names):
        return None
    model = assemble_model(
        discovery.model.library,
        [refitted[state] for state in run.state_names],
        units=run.units,
        provenance={**discovery.model.provenance, "search": "published terms, refitted"},
    )
    return integrate(model, run, n_samples)


def samples_in(run: Trajectory, duration_s: float) -> int:
    """Number of samples in the first `duration_s`, or in all where the data end before.

    Raises ValueError for a duration that holds fewer than two samples.
    """
    n = int(np.searchsorted(run.t, run.t[0] + duration_s * (1 + 1e-9), side="right"))
    if n < 2:
        raise ValueError(
            f"a window must hold two samples: {duration_s:g} s was asked of steps of {run.dt_s:g} s"
        )
    return n


def _frequencies(model: SparseModel, rollout: Rollout, run: Trajectory) -> dict[str, float]:
    found = {}
    for name, column in zip(model.states, rollout.states.T, strict=True):
        alive = column[len(column) // 2 :].std() > 0.1 * run.columns([name]).std()
        steady = alive and not rollout.diverged
        found[name] = dominant_frequency(rollout.t, column) if steady else float("nan")
    return found


def _nrmse(rollout: Rollout, run: Trajectory) -> float:
    if rollout.diverged:
        return float("nan")
    data = run.states[: len(rollout.t)]
    return float(np.sqrt(np.mean(np.square((rollout.states - data) / data.std(axis=0)))))


def front_table(
    front: ParetoFront, scores: Float[np.ndarray, " candidates"], *, label: str
) -> pd.DataFrame:
    """A front as the thesis's Tables I-III: one row per candidate, with its equation.

    scores: one per candidate, the lowest selected, in a column called `label`.
    """
    chosen = selected(front, scores)
    return pd.DataFrame(
        {
            "equation": front.equation,
            "n_terms": [c.n_terms for c in front.candidates],
            "r2_test": [c.r2_test for c in front.candidates],
            "r2_train": [c.r2_train for c in front.candidates],
            label: scores,
            "share": [c.share for c in front.candidates],
            "selected": [c is chosen for c in front.candidates],
            "text": [candidate_text(c) for c in front.candidates],
        }
    )


def candidate_text(candidate: Candidate) -> str:
    """`n_i' = -2.62e+05 n_i + 5.48e-14 n_i n_n`."""
    return equation_text(candidate.equation, candidate.coef_by_term)
