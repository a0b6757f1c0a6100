"""Ways of finding the coefficients of a structure, and the models that are found, run freely."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.forecasting.evaluation import Evaluation
from ep2sindy.library.library import Library
from ep2sindy.library.relations import Constraint
from ep2sindy.library.roles import Role
from ep2sindy.model.model import SparseModel
from ep2sindy.model.restarts import Restarts
from ep2sindy.refinement.windows import dominant_window
from ep2sindy.regression.constrained import constrained_fit, rows_r2
from ep2sindy.regression.rows import Formulation
from ep2sindy.report.results import Metric, Metrics, View
from ep2sindy.studies.processes import Zones, compared_processes
from ep2sindy.studies.structures import Structure, balance_model
from ep2sindy.studies.views import EVALUATION, largest

if TYPE_CHECKING:
    from ep2sindy.refinement.refine import Refinement

BALANCE = "balance"  # the form of a fit of every process to the recorded balance
STARTED = "_started"  # ends the names of what concerns runs from a fitted start


@dataclass(frozen=True)
class Fit:
    """A way of finding coefficients.

    form: of the regression, one of those that the config names; None means the formulation;
    "balance" fits every process to the rate that a simulation records. relations: whether those of
    a structure hold. refine: whether trajectories are followed then.
    """

    form: str | None = None
    relations: bool = True
    refine: bool = False


@dataclass(frozen=True)
class Way:
    """One fit with its form; None means the recorded balance."""

    name: str
    fit: Fit
    form: Formulation | None


def ways_of(
    fits: Mapping[str, Fit], forms: Mapping[str, Formulation], usual: Formulation
) -> list[Way]:
    """Every fit with its form. Raises ValueError for a form that is not named."""
    for name, fit in fits.items():
        if fit.form not in (None, BALANCE, *forms):
            raise ValueError(
                f"fits.{name}.form must be null, {BALANCE} or one of {list(forms)}: got "
                f"{fit.form!r}"
            )
    return [
        Way(name, fit, usual if fit.form is None else forms.get(fit.form))
        for name, fit in fits.items()
    ]


@dataclass(frozen=True, eq=False)
class RecordParts:
    """A record to fit: all of it, the part that is fitted, the one that is run over, its zones."""

    data: Trajectory
    train: Trajectory
    held: Trajectory
    zones: Zones


@dataclass(frozen=True, eq=False)
class FirstModel:
    """A model as a regression or a config gives it, before trajectories are followed.

    held_to: None for coefficients that are given. r2: of the derivative, by state, on the rows of
    the fit.
    """

    model: SparseModel
    held_to: Constraint | None
    r2: Mapping[str, float]


def first_model(
    structure: Structure, library: Library, way: Way, record: RecordParts, *, seed: int
) -> FirstModel:
    """The model by least squares, or as it is given. seed: of random windows."""
    train = record.train
    if structure.coefficients:
        return FirstModel(structure.given(library, train), None, {})
    held_to = structure.constraint(library, record.data, record.zones, relations=way.fit.relations)
    if way.form is None:
        model = balance_model(library, held_to, record.data, record.zones)
        return FirstModel(model, held_to, {})
    rows = way.form.assemble([train], library, rng=np.random.default_rng(seed))
    words = {"formulation": repr(way.form), "trajectories": train.label}
    model = constrained_fit(rows, held_to, units=train.units, provenance=words)
    # Smoothed rows and overlapping windows are not independent: their intervals would be too
    # narrow. Rows that know the noise of their samples are.
    if any(problem.noisy is None for problem in rows):
        model = replace(model, covariance=None)
    return FirstModel(model, held_to, rows_r2(model, rows))


@dataclass(frozen=True, eq=False)
class Fitted:
    """A model of one structure, fitted in one way, and its free runs over the same samples.

    name: of the structure. from_sample: from the first sample. from_fit: from a start fitted to the
    first samples. cpu_s: of the fit; of a refinement without that of its first model. refinement:
    how trajectories were followed, if they were. wrong: the terms whose sign contradicts the
    recorded balance.
    """

    name: str
    structure: Structure
    way: Way
    first: FirstModel
    model: SparseModel
    from_sample: Evaluation
    from_fit: Evaluation
    cpu_s: float
    refinement: Refinement | None
    wrong: Sequence[str]

    @property
    def n_free(self) -> int:
        return 0 if self.first.held_to is None else len(self.first.held_to.free)

    @property
    def r2(self) -> Mapping[str, float]:
        """R2 of the derivative by state, for a model that is fitted to it."""
        return {} if self.refinement else self.first.r2


FITTED: Metrics[Fitted] = [
    Metric("n_free", lambda fitted: fitted.n_free, View.SHOWN, "free"),
    *(metric.of(lambda fitted: fitted.from_sample) for metric in EVALUATION),
    *(
        metric.of(lambda fitted: fitted.from_fit, f"{{}}{STARTED}", View.FILES)
        for metric in EVALUATION
    ),
    Metric("wrong_signs", lambda fitted: "; ".join(fitted.wrong), View.SHOWN, "signs wrong"),
    Metric("r2", lambda fitted: fitted.r2, View.FILES | View.HEADLINE),
    Metric("loss", lambda fitted: fitted.refinement and fitted.refinement.loss),
    Metric(
        "refinement", lambda fitted: fitted.refinement and str(fitted.refinement.status), View.SHOWN
    ),
    Metric("cpu_s", lambda fitted: fitted.cpu_s, View.FILES | View.HEADLINE),
]


def fitted_start(model: SparseModel, run: Trajectory) -> Float[np.ndarray, " n_states"]:
    """Initial state whose trajectory is closest to the first one and a half periods of data."""
    n_samples = min(dominant_window([run], model.states), run.n_samples)
    (start,) = Restarts(model, run).fitted(np.zeros(1, dtype=np.int64), n_samples - 1)
    return start


def wrong_signs(model: SparseModel, held_to: Constraint | None, record: RecordParts) -> list[str]:
    """Terms of processes whose sign is not that by which the recorded balance has them."""
    if held_to is None or not held_to.processes or not record.zones.balances:
        return []
    return [
        f"{Role(*process.ends, how=None).name} by {term}"
        for process in compared_processes(model, held_to, record.data, record.zones)
        for term, coef in process.coef.items()
        if coef * process.counterpart.get(term, coef) < 0.0
    ]


# Several runs of one fit: over draws of windows, or over operating points.


def ends(value: Callable[[Evaluation], float], runs: Sequence[Evaluation]) -> list[float]:
    """Lowest and highest value over the runs that have it; NaN if none has it."""
    values = np.array([value(run) for run in runs])
    known = values[np.isfinite(values)]
    return [float(known.min()), float(known.max())] if known.size else [np.nan, np.nan]


def n_sustained(runs: Sequence[Evaluation]) -> int:
    return sum(run.holds for run in runs)


def worst_amplitude(run: Evaluation) -> float:
    """Amplitude over the data's, of the state that is farthest off."""
    return max(run.amplitude_ratio.values(), key=lambda ratio: abs(ratio - 1.0))


def count_words(words: Sequence[str], between: str) -> str:
    """`decays at 2, diverges at 1`: how often each of the words comes."""
    return between.join(f"{word} at {words.count(word)}" for word in dict.fromkeys(words))


def _range(ends: Sequence[float], form: str = "{:.3f} to {:.3f}", factor: float = 1.0) -> str:
    low, high = (factor * value for value in ends)
    return "-" if np.isnan(low) else form.format(low, high)


_PERCENT = partial(_range, form="{:+.2f} to {:+.2f} %", factor=100.0)
SEVERAL: Metrics[Sequence[Evaluation]] = [
    Metric("n_runs", len),
    Metric("n_sustained", n_sustained, View.FILES | View.HEADLINE),
    Metric("sustained", lambda runs: f"{n_sustained(runs)} of {len(runs)}", View.SCREEN),
    Metric(
        "elsewhere", lambda runs: count_words([str(r.status) for r in runs if not r.holds], ", "),
        View.SHOWN,
    ),
    Metric("f_error", partial(ends, lambda run: run.f_error), View.SHOWN, format=_PERCENT),
    Metric("nrmse", partial(ends, lambda run: run.nrmse)),
    Metric("amplitude", partial(ends, worst_amplitude), View.SHOWN, format=_range),
    Metric(
        "waveform", partial(ends, lambda run: largest(run.waveform_error)), View.SHOWN,
        format=_range,
    ),
]  # fmt: skip
SEVERAL_NOTE = (
    "Lowest and highest, from the first sample, where the model has a cycle; amplitude (times the "
    "data's) and waveform are those of the state that is farthest off."
)
