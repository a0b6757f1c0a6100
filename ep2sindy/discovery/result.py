"""The result of a discovery: what was found, what was weighed, and how it is shown and stored."""

from __future__ import annotations

import html
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from ep2sindy._stubs import dotted_names, place_of
from ep2sindy.data.coerce import DiscoveryProblem
from ep2sindy.data.runs import Run, Runs
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.estimation.estimate import Estimate
from ep2sindy.forecasting.evaluation import Evaluation, evaluate
from ep2sindy.forecasting.forecast import Forecast, forecast
from ep2sindy.library.relations import Constraint, Process
from ep2sindy.model.display import model_html, model_lines
from ep2sindy.model.model import SparseModel
from ep2sindy.model.rollout import Rollout
from ep2sindy.model.storage import read_as, read_stored
from ep2sindy.operating.law import OperatingLaw
from ep2sindy.operating.records import most_central
from ep2sindy.regression.ambiguity import Ambiguity
from ep2sindy.regression.front import Candidate, Ensemble, ParetoFront, Residual
from ep2sindy.runtime.files import write_text
from ep2sindy.runtime.progress import SILENT, Progress
from ep2sindy.runtime.screen import N_LINES, one_screen, sentences
from ep2sindy.selection.criteria import OtherSystem, Selection

if TYPE_CHECKING:
    from ep2sindy.operating.left_out import LawChoice

FORMAT = "ep2sindy.Discovery/1"

MAX_NOTES = 6  # shown in the repr


@dataclass(frozen=True, eq=False)
class NoiseTest:
    """Test whether a model explains the data to within their noise.

    left: for each state, the residuals of its equation on rows. It is empty if no rows were tested,
    as after a trajectory search, which tests whole trajectories.
    lack_of_fit: the reason why the model does not explain the data; empty if it does, or if nothing
    was tested. tested: False if nothing was tested. n_free: for each state named by a relation that
    holds in the model, the number of free coefficients of its equation. note: on states without a
    law, which rest or drift; empty if there are none.
    """

    left: Mapping[str, Residual] = field(default_factory=dict)
    lack_of_fit: str = ""
    tested: bool = False
    n_free: Mapping[str, int] = field(default_factory=dict)
    note: str = ""


@runtime_checkable
class DiscoveryMethod(Protocol):
    """Protocol of a method that finds equations from runs: `TrajectorySearch`, or `Regression`.

    selection: the rule that chooses among candidates; it is named in the headline of the result.
    identify: answers a `DiscoveryProblem`. A method of one's own may ask another one:

    >>> class Smallest:
    ...     selection = ep.discovery.Evidence()
    ...
    ...     def identify(self, task, *, rng, progress):
    ...         own = ep.TrajectorySearch(max_terms=2)
    ...         return own.identify(task, rng=rng, progress=progress)
    >>> run = ep.lotka_volterra().trajectory(noise=0.01, rng=0)
    >>> list(ep.discover(run, method=Smallest()).model.terms("x"))
    ['x', 'x*y']
    """

    @property
    def selection(self) -> Selection: ...

    def identify(
        self, task: DiscoveryProblem, *, rng: np.random.Generator, progress: Progress = SILENT
    ) -> Discovery: ...


# What a file may hold next to the values that configs may name.
STORED = {
    kind.__name__: kind
    for kind in (
        Ambiguity,
        Candidate,
        Ensemble,
        Constraint,
        Residual,
        NoiseTest,
        OtherSystem,
        ParetoFront,
        Process,
    )
}


@dataclass(frozen=True, eq=False)
class Discovery:
    """Result of `discover`: the candidates of every state, and the model of the selected ones.

    It prints the equations with 95 % intervals, and what limits them.

    Parameters
    ----------
    fronts : mapping of str to ParetoFront
        For each state, its candidates with their scores. The lowest score is selected.
    chosen : mapping of str to Candidate
        For each state, the selected candidate with its coefficients in the model. If the noise of
        the samples is propagated into the rows, the coefficients come from a weighted refit.
    model : SparseModel
        The selected equations, with the covariance of their coefficients.
    method : DiscoveryMethod
        The method that found the model.
    ambiguities : sequence of Ambiguity, default ()
        Terms that these data cannot distinguish, and warnings of too few rows for the terms.
    noise_test : NoiseTest, default NoiseTest()
        Test of the residuals against the noise.
    note : str, default ''
        How a rule for whole systems decided, how certain a trajectory search is, or that the
        residuals exceed the noise. Otherwise empty.
    data_warnings : sequence of str, default ()
        Sentences on where the samples deviate from the assumptions.
    estimate : Estimate, optional
        The states and coefficients estimated together, after a trajectory search.
    constraint : Constraint, optional
        What the model's coefficients obey under relations or roles, for use in `refine`. None
        without.
    others : sequence of OtherSystem, default ()
        After a rule that runs whole systems: the systems with as many free coefficients that also
        sustain their oscillation.
    points : mapping of str to Discovery, default {}
        For runs at several operating points, the discovery at each, by its label, such as
        "V_D_V=300, mdot_mg_s=5". The model and all else are then those of the most central point.
    law : OperatingLaw, optional
        The law of all coefficients over the operating points, if it was asked for.
    law_choice : LawChoice, optional
        How the law was chosen, and its runs at points left out. None without a law.
    records : sequence of Trajectory, default ()
        The samples that the model is judged by, hidden states among them as they were estimated.
    judged : str, default ''
        The verdict, of a discovery that was read from a file, which holds no samples.

    Examples
    --------
    >>> run = ep.lotka_volterra().trajectory(noise=0.05, rng=0)
    >>> found = ep.discover(run)
    >>> found.model.terms("x")
    {'x': 0.66..., 'x*y': -0.99...}
    >>> found.fronts["y"].candidates[2].terms
    ('y', 'x*y')
    """

    fronts: Mapping[str, ParetoFront] = field(repr=False)
    chosen: Mapping[str, Candidate]
    model: SparseModel = field(repr=False)
    method: DiscoveryMethod
    ambiguities: Sequence[Ambiguity] = ()
    noise_test: NoiseTest = field(default_factory=NoiseTest)
    note: str = ""
    data_warnings: Sequence[str] = ()
    estimate: Estimate | None = field(default=None, repr=False)
    constraint: Constraint | None = field(default=None, repr=False)
    others: Sequence[OtherSystem] = field(default=(), repr=False)
    points: Mapping[str, Discovery] = field(default_factory=dict, repr=False)
    law: OperatingLaw | None = field(default=None, repr=False)
    law_choice: LawChoice | None = field(default=None, repr=False)
    records: Sequence[Trajectory] = field(default=(), repr=False)
    judged: str = ""

    @cached_property
    def evaluation(self) -> Evaluation | None:
        """What is said of the model, by the records that it was found in; None without these."""
        if not self.records:
            return None
        states, found = self.model.states, self.estimate
        noise = np.zeros(len(states)) if found is None else found.noise_std
        measured = [s for s, std in zip(states, noise, strict=True) if not np.isnan(std)]
        return evaluate(self, self.records, assessed=measured)

    @property
    def verdict(self) -> str:
        """What is said of the model, in a few words; see `Evaluation.heading`.

        Of several points, at how many of them what is said; by the law, if there is one, unless the
        records are better interpolated.
        """
        if not self.points:
            return self.judged if self.evaluation is None else self.evaluation.heading
        found, choice = [own.evaluation for own in self.points.values()], self.law_choice
        if choice is not None:
            if choice.runs and not choice.is_trusted:
                return choice.heading
            found = [*choice.fitted]
        words = Counter(_said(each) for each in found if each is not None)
        counts = ", ".join(f"{word} at {n}" for word, n in words.most_common() if word)
        return f"{counts} of {len(self.points)}" if counts else self.judged

    @property
    def scores(self) -> dict[str, Float[np.ndarray, " _candidates"]]:
        """For each state, one score per candidate of its front, the lowest selected."""
        return {state: front.scores for state, front in self.fronts.items()}

    @property
    def lack_of_fit(self) -> str:
        """The reason why the model does not explain the data to within their noise.

        Empty if it does, or if the model was not tested: `noise_test.tested` is then False.
        """
        return self.noise_test.lack_of_fit

    def simulate(
        self,
        t: ArrayLike,
        x0: ArrayLike | Mapping[str, float],
        inputs: ArrayLike | Mapping[str, Any] | None = None,
        *,
        draws: int = 0,
        seed: int = 0,
    ) -> Rollout:
        """Integrate the model freely from the state x0 at t[0]; see `SparseModel.simulate`."""
        return self.model.simulate(t, x0, inputs, draws=draws, seed=seed)

    def score(
        self,
        runs: Runs,
        *,
        x_dot: Float[np.ndarray, "samples n_states"] | None = None,
        horizon_s: float | None = None,
    ) -> float:
        """R2 of the model's forecasts over one step; see `SparseModel.score`."""
        return self.model.score(runs, x_dot=x_dot, horizon_s=horizon_s)

    def forecast(
        self,
        history: Run,
        horizon: float | ArrayLike,
        *,
        fitted_to: Run | None = None,
        inputs: ArrayLike | Mapping[str, Any] | None = None,
        n_draws: int = 200,
        seed: int = 0,
    ) -> Forecast:
        """Forecast from the end of a record, with bands; see `ep.forecast`.

        Parameters
        ----------
        history : run
            The samples before the forecast.
        horizon : float or array-like
            Duration in s, or times in s.
        fitted_to : run, optional
            The record that the model was fitted to. None takes the history.
        inputs : array-like or mapping of str to any, optional
            Inputs of a driven model over the horizon.
        n_draws : int, default 200
            Number of runs of which the bands are made.
        seed : int, default 0
            Of the random draws.

        Returns
        -------
        Forecast
            Median and bands.
        """
        return forecast(
            self.model, history, horizon, fitted_to=fitted_to, inputs=inputs, n_draws=n_draws,
            seed=seed,
        )  # fmt: skip

    def to_json(self) -> str:
        """JSON text of all but the samples; floats in their shortest exact form.

        Not stored are the rows behind `fronts`, and `estimate`, which holds every sample.
        Raises ValueError if the method, or a part of it, is a class of your own.
        """
        without_rows = {state: replace(f, problem=None) for state, f in self.fronts.items()}
        parts = replace(self, fronts=without_rows)
        content = {"format": FORMAT, "model": json.loads(self.model.to_json())}
        content |= {name: _encode(getattr(parts, name)) for name in _PARTS}
        content["points"] = {label: json.loads(own.to_json()) for label, own in self.points.items()}
        content["law"] = None if self.law is None else json.loads(self.law.to_json())
        content["judged"] = self.verdict
        return json.dumps(content, indent=1, allow_nan=False) + "\n"

    @staticmethod
    def from_json(text: str) -> Discovery:
        """Inverse of `to_json`, exact; fronts have no rows then, and `estimate` is None.

        No code from the text runs, and functions of your own must be registered before.
        Raises ValueError for anything else.
        """
        with read_as("a discovery must be", FORMAT, text) as content:
            model = SparseModel.from_json(json.dumps(content["model"]))
            law, points = content["law"], content["points"]
            found = Discovery(
                model=model,
                judged=str(content["judged"]),
                **{name: _decode(content[name]) for name in _PARTS},
                points={p: Discovery.from_json(json.dumps(own)) for p, own in points.items()},
                law=None if law is None else OperatingLaw.from_json(json.dumps(law)),
            )
            _check_parts(found)
            return found

    def save(self, path: str | Path) -> None:
        """Write the discovery as JSON, completely or not at all; see `to_json`."""
        write_text(Path(path), self.to_json())

    @staticmethod
    def load(path: str | Path) -> Discovery:
        """Read what `save` has written; see `from_json`."""
        return read_stored(Path(path), Discovery.from_json)

    def __repr__(self) -> str:
        shown = self._notes()[:MAX_NOTES]
        notes = [line for each in shown for line in sentences(f"note: {each}")]
        left = len(self._notes()) - len(shown)
        tail = [*notes, *([f"... {left} more notes"] if left else [])]
        head = [line for text in self._lines_of_choice() for line in sentences(text)]
        n_lines = N_LINES - len(head) - len(tail)
        body = model_lines(self.model, self.constraint, n_lines=n_lines)
        if self.points:
            body = self._lines_of_points()[:n_lines]
        return one_screen([*head, *body, *tail])

    def _lines_of_points(self) -> list[str]:
        if self.law is not None:
            return self.law.text().splitlines()
        return [
            f"{label}: {line}"
            for label, own in self.points.items()
            for line in own.model.text().splitlines()
        ]

    def _repr_html_(self) -> str:
        notes = "".join(f"<li>{html.escape(each)}</li>" for each in self._notes())
        lines = self._lines_of_choice()
        if self.points:
            lines += self._lines_of_points()
        head = "".join(f"<div>{html.escape(line)}</div>" for line in lines)
        if self.points:
            return head
        return (
            head + model_html(self.model, self.constraint) + (f"<ul>{notes}</ul>" if notes else "")
        )

    def _notes(self) -> list[str]:
        return [*self.data_warnings, *(each.message for each in self.ambiguities)]

    def _lines_of_choice(self) -> list[str]:
        """The verdict, how the model was chosen, and what that left open."""
        chosen = f"chosen by {self.method.selection!r}"
        return [self._headline(), chosen, *([self.note] if self.note else [])]

    def _headline(self) -> str:
        where = ""
        if self.points:
            how = "one law" if self.law else "one support" if self._is_shared else "each alone"
            where = f" at {len(self.points)} operating points, {how}"
        n = len(self.model.states)
        if (verdict := self.verdict).startswith("no equations found") and not self.points:
            return f"Discovery: {verdict}"
        return f"Discovery of {n} equation{'s' * (n > 1)}{where}{verdict and f': {verdict}'}"

    @property
    def _is_shared(self) -> bool:
        """True if the supports of all points were compared together: their scores are one."""
        first, *others = self.points.values()
        return all(
            state in own.scores and np.array_equal(first.scores[state], own.scores[state])
            for own in others
            for state in first.scores
        )


def _said(found: Evaluation) -> str:
    """The status at a point, or that no equations were found."""
    return "no equations found" if found.rival else str(found.status)


def join_points(
    points: Mapping[str, Discovery],
    values: Float[np.ndarray, "points parameters"],
    choice: LawChoice | None = None,
) -> Discovery:
    """The discoveries of all points as one, which shows that of the most central point."""
    central = list(points.values())[most_central(values)]
    law = None if choice is None else choice.law
    return replace(central, points=points, law=law, law_choice=choice)


# Fields of a Discovery that are stored next to the model, and the kind of each or of its values.
_PARTS: Mapping[str, Any] = {
    "fronts": ParetoFront,
    "chosen": Candidate,
    "method": DiscoveryMethod,
    "ambiguities": Ambiguity,
    "noise_test": NoiseTest,
    "note": str,
    "data_warnings": str,
    "constraint": Constraint | None,
    "others": OtherSystem,
}
_SINGLE = {"method", "noise_test", "note", "constraint"}


def _encode(value: Any) -> Any:
    """A value as JSON that `_decode` reads: arrays, mappings and dataclasses say what they are.

    Raises ValueError for a value that is neither in `STORED` nor one that configs may name.
    """
    if isinstance(value, float) and not np.isfinite(value):
        return {"number": repr(float(value))}
    if value is None or isinstance(value, str | int | float):
        return value
    if isinstance(value, np.ndarray):
        numbers = [_encode(number) for number in value.ravel().tolist()]
        return {"array": numbers, "shape": list(value.shape), "type": value.dtype.name}
    if isinstance(value, Mapping):
        return {"mapping": [[_encode(key), _encode(each)] for key, each in value.items()]}
    if isinstance(value, list | tuple):
        return [_encode(each) for each in value]
    name = type(value).__name__ if type(value) in STORED.values() else place_of(type(value))
    if name is None or not is_dataclass(value):
        raise ValueError(
            "a discovery is stored with its method, of classes of this package alone, got "
            f"{value!r}; store its model, found.model.save(path)"
        )
    return {"class": name, **{f.name: _encode(getattr(value, f.name)) for f in fields(value)}}


def _decode(content: Any) -> Any:
    """Inverse of `_encode`; lists become tuples. Raises ValueError for a class of another kind."""
    if isinstance(content, list):
        return tuple(_decode(each) for each in content)
    if not isinstance(content, dict):
        return content
    if "number" in content:
        return float(content["number"])
    if "mapping" in content:
        return {_decode(key): _decode(each) for key, each in content["mapping"]}
    if "array" in content:
        if content["type"] not in ("float64", "int64", "bool"):
            raise ValueError(f"an array of type {content['type']!r:.80}")
        numbers = [_decode(number) for number in content["array"]]
        return np.array(numbers, dtype=content["type"]).reshape(content["shape"])
    kind = _class_named(content["class"])
    return kind(**{name: _decode(each) for name, each in content.items() if name != "class"})


def _class_named(name: str) -> type:
    """One of `STORED`, or a dataclass of the face that configs, of anybody, may name as well."""
    entry = dotted_names().get(name)
    kind = STORED.get(name) or (entry.load() if entry is not None and entry.for_configs else None)
    if not (isinstance(kind, type) and is_dataclass(kind)):
        raise ValueError(f"no class {name!r:.80} may stand in such a file")
    return kind


def _check_parts(found: Discovery) -> None:
    """Raise ValueError for parts of other kinds, or not of the model's states and terms."""
    for name, kind in _PARTS.items():
        part = getattr(found, name)
        values = part.values() if isinstance(part, Mapping) else part
        if not all(isinstance(each, kind) for each in ([part] if name in _SINGLE else values)):
            raise ValueError(f"{name} of another kind: {part!r:.80}")
    if {*found.fronts, *found.chosen} != set(found.model.states):
        raise ValueError(f"fronts and candidates of other states than {found.model.states}")
    for state, front in found.fronts.items():
        for each in (*front.candidates, found.chosen[state]):
            known = set(each.terms) <= set(found.model.library.names)
            if each.equation != state or not known or each.coef.shape != (len(each.terms),):
                raise ValueError(f"a candidate that is no equation of {state}: {each!r:.80}")
