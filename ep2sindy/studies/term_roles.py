"""Roles of a living model's terms: compared to zone means, left out in turn, tied together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.discover import Discovery
from ep2sindy.library.relations import Constraint, Relation, constraint, parse_relation
from ep2sindy.model.comparison import FreeRunBounds
from ep2sindy.model.free_run import FreeRun, free_run
from ep2sindy.model.model import SparseModel
from ep2sindy.regression.constrained import constrained_fit
from ep2sindy.report.document import Section, Table, Text, places
from ep2sindy.report.results import Metric, Metrics, ResultTable, View, facts
from ep2sindy.runtime.progress import SILENT, Progress, count_pieces
from ep2sindy.studies.living import start_of, two_periods
from ep2sindy.thruster.parameters import NeutralSpeed

if TYPE_CHECKING:
    from ep2sindy.refinement.refine import Refinement


@dataclass(frozen=True)
class Compared:
    """Quantities that the coefficients of ions and neutrals in a zone are compared to.

    ions, neutrals: the states. ion_velocity (m/s), ionization_rate (m^3/s): variables of the data.
    neutral_speed: in m/s; of a table along the axis that at the exit; None if it is not known.
    """

    ions: str
    neutrals: str
    ion_velocity: str
    ionization_rate: str
    neutral_speed: float | NeutralSpeed | None

    def expected(
        self, data: Trajectory, length_m: float | None
    ) -> dict[tuple[str, str], tuple[str, float]]:
        """The coefficients that a balance of the zone gives: (state, term) -> (words, SI value).

        The balance is d n/dt = -u n/L + inflow, and ionization takes from the neutrals what it
        gives to the ions. length_m: length of the zone, None if it has none. Terms whose variables
        the data lack are left out.
        """
        found: dict[tuple[str, str], tuple[str, float]] = {}
        product = f"{self.ions}*{self.neutrals}"
        if self.ion_velocity in data.names and length_m is not None:
            rate = float(data.columns([self.ion_velocity]).mean()) / length_m
            found[self.ions, self.ions] = (f"-mean {self.ion_velocity}/L", -rate)
        if self.neutral_speed is not None and length_m is not None:
            speed = self.neutral_speed
            if isinstance(speed, NeutralSpeed):
                speed = float(speed.at(np.zeros(1))[0])
            found[self.neutrals, self.neutrals] = ("-u_n/L", -speed / length_m)
        if self.ionization_rate in data.names:
            rate = float(data.columns([self.ionization_rate]).mean())
            found[self.ions, product] = (f"mean {self.ionization_rate}", rate)
            found[self.neutrals, product] = (f"-mean {self.ionization_rate}", -rate)
        return found


@dataclass(frozen=True, eq=False)
class Role:
    """One term of the model.

    expected: the term's coefficient in a balance of the zone, in words and in SI; None if the
    balance has no such term. without: free run of the refined model without the term; None if it
    cannot be refined.
    """

    state: str
    term: str
    coef: float
    expected: tuple[str, float] | None
    without: FreeRun | None


@dataclass(frozen=True, eq=False)
class Roles:
    """The roles of a model's terms.

    shared: run of the model in which ionization is one coefficient with opposite signs for ions and
    neutrals; None if it cannot be refined.
    """

    terms: Sequence[Role]
    shared: FreeRun | None

    def table(self) -> pd.DataFrame:
        return ResultTable(self.terms, ROLES).csv()

    def section(self, name: str) -> Section:
        """One row per term: its value in a balance of the zone, and the model without it."""
        shared = facts(self.shared, WITHOUT)
        text = f"Ionization as one coefficient of opposite signs: {shared['verdict']}"
        if self.shared is not None:
            terms = "; ".join(self.shared.model.text().splitlines())
            text += f", waveform {places(shared['waveform_error'], 3)} ({terms})"
        rows = ResultTable(self.terms, ROLES).screen()
        table = Table(rows, title="each term beside a balance of the zone, and left out")
        return Section(f"{name}: what the terms mean", [table, Text(f"{text}.")], level=3)

    def summary(self) -> dict[str, Any]:
        """The entry in `summary.json`."""
        text = None if self.shared is None else self.shared.model.text()
        return {
            "terms": [facts(role, ROLES) for role in self.terms],
            "shared_ionization": facts(self.shared, WITHOUT) | {"text": text},
        }


# Metrics of a refined model without one term; None if it cannot be refined.
WITHOUT: Metrics[FreeRun | None] = [
    Metric(
        "verdict", lambda run: run.text if run else "cannot be refined", View.SHOWN, "without it"
    ),
    Metric("f_error", lambda run: run.f_error if run else np.nan),
    Metric(
        "waveform_error",
        lambda run: max(run.waveform_error.values()) if run else np.nan,
        View.SHOWN,
        "waveform",
        "{:.3f}",
    ),
]
ROLES: Metrics[Role] = [
    Metric("state", lambda role: role.state),
    Metric("equation", lambda role: f"{role.state}'", View.SCREEN),
    Metric("term", lambda role: role.term, View.SHOWN),
    Metric("coefficient", lambda role: role.coef, View.SHOWN),
    Metric(
        "balance", lambda role: role.expected[0] if role.expected else "", View.SHOWN,
        "in a balance",
    ),
    Metric(
        "balance_value", lambda role: role.expected[1] if role.expected else np.nan, View.SHOWN,
        "value",
    ),
    *(metric.of(lambda role: role.without, "without_{}") for metric in WITHOUT),
]  # fmt: skip


def term_roles(
    found: Discovery,
    data: Trajectory,
    train: Trajectory,
    held: Trajectory,
    compared: Compared,
    bounds: FreeRunBounds,
    *,
    length_m: float | None,
    progress: Progress = SILENT,
) -> Roles:
    """Leave out each term in turn, then share the ionization coefficient; refine and run all.

    Models are refined on `train` and run over `held`. length_m: length of the zone.
    """
    model, expected = found.model, compared.expected(data, length_m)
    support = {state: list(model.terms(state)) for state in model.states}
    roles, window = [], two_periods(train)
    terms = [(s, term, coef) for s in model.states for term, coef in model.terms(s).items()]
    for state, term, coef in count_pieces(progress, terms, "term", "models without a term"):
        less = support | {state: [name for name in support[state] if name != term]}
        run = None
        if less[state]:
            run = _run(found, less, (), train, held, bounds, progress, window=window)
        roles.append(Role(state, term, coef, expected.get((state, term)), run))
    product = f"{compared.ions}*{compared.neutrals}"
    relation = parse_relation(f"{compared.ions}: {product} == -1 * {compared.neutrals}: {product}")
    both = {state: list(dict.fromkeys([*terms, product])) for state, terms in support.items()}
    shared = _run(found, both, (relation,), train, held, bounds, progress, window=window)
    return Roles(roles, shared)


def _run(
    found: Discovery,
    support: dict[str, list[str]],
    relations: Sequence[Relation],
    train: Trajectory,
    held: Trajectory,
    bounds: FreeRunBounds,
    progress: Progress,
    *,
    window: int | None,
) -> FreeRun | None:
    """Fit terms, refine them on windows of `window` samples, and run them; None if not finite."""
    held_to = constraint(found.model.library, support, relations)
    problems = list(dict.fromkeys(front.rows for front in found.fronts.values()))
    start = constrained_fit(problems, held_to, units=train.units)
    refined = _refined(start, held_to, train, progress, window=window)
    if refined.status == "non_finite":
        return None
    initial = start_of(held, refined.model)
    return free_run(refined.model, held, initial=initial, bounds=bounds)


def _refined(
    start: SparseModel,
    held_to: Constraint,
    train: Trajectory,
    progress: Progress,
    *,
    window: int | None,
) -> Refinement:
    from ep2sindy.refinement.refine import refine  # loads torch, only for a refinement

    return refine(
        start,
        [train],
        window=window,
        constraint=held_to,
        n_reweights=0,
        rng=0,
        progress=progress,
    )
