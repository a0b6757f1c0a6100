"""Tables of the predicted operating points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import ndtri

from ep2sindy.operating.choice import Branch, Tried
from ep2sindy.operating.fit import LeftOut
from ep2sindy.operating.map import Fate, MapPoint
from ep2sindy.operating.records import OperatingRecord, point_label
from ep2sindy.signals.oscillation import OSCILLATING

Parameters = Mapping[str, float]


def points_table(
    points: Sequence[Parameters],
    statuses: Mapping[str, str],
    records: Sequence[OperatingRecord],
    members: Mapping[str, Sequence[Parameters]],
) -> pd.DataFrame:
    """One row per operating point: what its record is, and on which cycle."""
    known = {point_label(record.parameters): record for record in records}
    cycle = {point_label(p): name for name, group in members.items() for p in group}
    rows = []
    for point in points:
        label = point_label(point)
        record = known.get(label)
        rows.append(
            {
                **point,
                "status": statuses[label],
                "branch": cycle.get(label, ""),
                "f_kHz": 1e-3 * record.cycle.frequency_Hz if record else np.nan,
                "relative_amplitude": record.relative_amplitude if record else np.nan,
            }
        )
    return pd.DataFrame(rows)


def laws_table(branches: Mapping[str, Branch]) -> pd.DataFrame:
    """One row per number of a law, with its 95 % interval."""
    rows = []
    for name, branch in branches.items():
        law = branch.law
        reach = np.full(law.coef.shape, np.nan)
        if law.covariance is not None:
            std = np.sqrt(np.maximum(np.diag(law.covariance), 0.0)).reshape(law.coef.shape)
            reach = ndtri(0.975) * std
        for (state, term), row, half in zip(law.coefficients, law.coef, reach, strict=True):
            for function, value, r in zip(law.functions.names, row, half, strict=True):
                rows.append((name, state, term, function, value, value - r, value + r))
    columns = ["branch", "state", "term", "function", "value", "low", "high"]
    return pd.DataFrame(rows, columns=columns)


def coefficients_table(branches: Mapping[str, Branch]) -> pd.DataFrame:
    """Coefficients at every point: refined alone, and by the law, each with 95 % intervals."""
    rows = []
    for name, branch in branches.items():
        pairs = zip(branch.fit.records, branch.fit.fits, branch.tied.models, strict=True)
        for record, alone, tied in pairs:
            for state in tied.states:
                for term, value in tied.terms(state).items():
                    row = {**record.parameters, "branch": name, "state": state, "term": term}
                    row |= {"alone": alone.model.terms(state)[term], "law": value}
                    for kind, model in (("alone", alone.model), ("law", tied)):
                        if model.covariance is not None:
                            low, high = model.intervals(state)[term]
                            row |= {f"{kind}_low": low, f"{kind}_high": high}
                    rows.append(row)
    return pd.DataFrame(rows)


def left_out_table(branches: Mapping[str, Branch]) -> pd.DataFrame:
    """One row per point: what the law of the others makes of it, and which cycles are there."""
    rows: list[dict[str, Any]] = []
    for name, branch in branches.items():
        for each in branch.left_out:
            rows.append({"branch": name, **_left_out_row(each, branches, name)})
    return pd.DataFrame(rows)


def _left_out_row(each: LeftOut, branches: Mapping[str, Branch], own: str) -> dict[str, Any]:
    run, record = each.run, each.record
    f_kHz = 1e-3 * record.cycle.frequency_Hz
    label = point_label(record.parameters)
    also = [
        name
        for name, branch in branches.items()
        for point in branch.at_points
        if name != own
        and point_label(point.parameters) == label
        and point.inside
        and point.fate is Fate.OSCILLATES
    ]
    return {
        **record.parameters,
        "enclosed": each.inside,
        "f_kHz": f_kHz,
        "f_model_kHz": f_kHz * (1.0 + run.f_error),
        "f_error": run.f_error,
        **{f"amplitude_{state}": ratio for state, ratio in run.amplitude_ratio.items()},
        **{f"waveform_{state}": error for state, error in run.waveform_error.items()},
        "verdict": str(run.verdict),
        "also": ", ".join(also),
    }


def states_of(left_out: pd.DataFrame) -> list[str]:
    """States of a table of points left out."""
    names = [str(name) for name in left_out]
    return [n.removeprefix("amplitude_") for n in names if n.startswith("amplitude_")]


def structures_table(branches: Mapping[str, Branch]) -> pd.DataFrame:
    """One row per structure and degree that was tried, with weighted laws at points left out."""
    rows = []
    for name, branch in branches.items():
        for each in branch.trials:
            rows.append({"branch": name, **_tried_row(each), "chosen": each is branch.choice})
    return pd.DataFrame(rows)


def _tried_row(each: Tried) -> dict[str, Any]:
    f_error = np.array([abs(one.run.f_error) for one in each.found])
    return {
        "terms": "; ".join(f"{s}: {', '.join(t)}" for s, t in each.fit.structure.items()),
        "degree": each.degree,
        "numbers": each.n_numbers,
        "error": float(each.errors.mean()),
        "f_error": float(np.median(np.where(np.isnan(f_error), np.inf, f_error))),
        "diverging": sum(one.run.rollout.diverged for one in each.found),
    }


def map_table(branches: Mapping[str, Branch], which: str) -> pd.DataFrame:
    """The law's models over the map, or at the points of the study (`at_points`)."""
    rows = []
    for name, branch in branches.items():
        points: Sequence[MapPoint] = branch.map if which == "map" else branch.at_points
        for point in points:
            rows.append(
                {
                    "branch": name,
                    **point.parameters,
                    "inside": point.inside,
                    "fate": str(point.fate),
                    "f_kHz": 1e-3 * point.frequency_Hz,
                    "relative_amplitude": point.relative_amplitude,
                    "growth_per_s": point.growth_per_s,
                    "second_multiplier": point.second,
                }
            )
    return pd.DataFrame(rows)


def agreement(
    branches: Mapping[str, Branch], statuses: Mapping[str, str]
) -> tuple[int, int, int, int]:
    """Points where some law says rightly whether it oscillates, of all; quiet ones, of these."""
    says = dict.fromkeys(statuses, False)
    for branch in branches.values():
        for point in branch.at_points:
            label = point_label(point.parameters)
            says[label] = says[label] or point.fate is Fate.OSCILLATES
    quiet = [label for label, status in statuses.items() if status != OSCILLATING]
    right = [says[label] == (statuses[label] == OSCILLATING) for label in statuses]
    return sum(right), len(right), sum(not says[label] for label in quiet), len(quiet)
