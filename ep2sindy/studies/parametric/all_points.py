"""One support for all operating points of a parametric study, free at each or tied by a law."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ep2sindy.discovery.coefficient_law import TiedFit, tied_fit
from ep2sindy.discovery.method import Regression
from ep2sindy.discovery.shared_support import JointDiscovery, discover_jointly
from ep2sindy.library.library import Library
from ep2sindy.machine.progress import SILENT, Progress
from ep2sindy.search.bootstraps import Bootstraps
from ep2sindy.search.searches import BestSubset
from ep2sindy.studies.parametric.oscillation import PointData, point_label
from ep2sindy.studies.parametric.points import SEARCHED, Fitted, PointResult, PointStudy


@dataclass(frozen=True, eq=False)
class JointResult:
    """What one search over all points that oscillate found.

    fitted: the support with coefficients of its own at every point, None at the others. tied: its
    coefficients as polynomials of the parameters; None where the points do not suffice, for the
    reason in `why_not_tied`.
    """

    found: JointDiscovery
    fitted: Sequence[Fitted | None]
    tied: TiedFit | None
    why_not_tied: str = ""


def searched_jointly(
    points: Sequence[PointData],
    results: Sequence[PointResult],
    study: PointStudy,
    law: Library,
    *,
    rng: np.random.Generator,
    progress: Progress = SILENT,
) -> JointResult | None:
    """Search all points that oscillate at once; None for fewer than two of them.

    law: terms that coefficients are tied by, over the parameters of the points.
    None, too, for a search that cannot weigh several points: only BestSubset does.
    """
    used = {
        point_label(point.parameters): point
        for point, result in zip(points, results, strict=True)
        if result.fits and point.trajectory is not None
    }
    if len(used) < 2 or not (
        isinstance(study.recipe, Regression) and isinstance(study.recipe.search, BestSubset)
    ):
        return None
    found = discover_jointly(
        {label: [point.trajectory] for label, point in used.items() if point.trajectory},
        study.searched,
        replace(study.recipe, bootstraps=Bootstraps(n=0)),
        seed=rng,
        progress=progress,
    )
    tied, reason = None, ""
    try:
        parameters = {label: point.parameters for label, point in used.items()}
        with progress.stage(None, "", "coefficients tied by a law"):
            tied = tied_fit(found, law, parameters=parameters)
    except ValueError as error:
        reason = str(error)
    labels = [point_label(point.parameters) for point in points]
    fitted = [_fitted(found, label) if label in used else None for label in labels]
    return JointResult(found, fitted, tied, reason)


def _fitted(found: JointDiscovery, label: str) -> Fitted:
    scores = {
        state: front.points[label].candidates[front.supports.index(found.chosen[state])].r2_train
        for state, front in found.fronts.items()
    }
    return Fitted(model=found.models[label], status=SEARCHED, r2=scores)
