"""Identification frontier: the sampling rate and duration needed to find known equations.

The experiment is `+exp=frontier`. Source: the thesis, appendix, III-B.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import numpy as np
import pandas as pd

from ep2sindy.figures.identified import frontier_figure
from ep2sindy.report.document import Result, Text
from ep2sindy.report.report import Report
from ep2sindy.runtime.parallel import Workers, rows_in_order
from ep2sindy.runtime.progress import SILENT, Progress
from ep2sindy.studies.benchmark import Variant, build_variants, merits
from ep2sindy.studies.study import Deferred, Names, Positives
from ep2sindy.systems.systems import System

FIGURE = (
    "Filled: the true equations of all states are on the variant's fronts. Hollow: they are not. "
    "Cross: too few samples for the variant to run, which counts as not identified."
)


@dataclass(frozen=True)
class Study:
    """Sample a system at all rates and durations, run every variant, and check the results.

    variants: names among the definitions.
    """

    system: System
    rates_Hz: Positives
    durations_s: Positives
    variants: Names
    definitions: Mapping[str, Deferred]
    parallel: Workers

    def run(self, report: Report) -> None:
        variants = build_variants(self.variants, self.definitions)
        points = self.points(variants, seed=report.seed, progress=report.watch)
        by_variant = points.groupby("variant", sort=False)
        too_few = points[points["reason"] != ""].groupby("variant", sort=False).size()
        counts = ", ".join(f"{variant} {n}" for variant, n in too_few.items())
        report.section(
            "Points",
            f"{self.system.name}: one noise-free trajectory per sampling rate and duration, all "
            f"from the same initial state. Points with too few samples to run: {counts or 'none'}; "
            "tables/points.csv says why.",
        )
        report.figure("frontier", partial(frontier_figure, points), FIGURE)
        report.table("points", points, shown=False)
        percent = 100.0 * by_variant["identified"].mean()
        report.headline |= {f"{n}/identified_percent": float(v) for n, v in percent.items()}
        fractions = "; ".join(f"{name} {fraction:.0f} %" for name, fraction in percent.items())
        report.found(
            Result(
                f"Found: {percent.idxmax()} identifies {self.system.name} at the largest fraction "
                f"of sampling rates and durations, {percent.max():.0f} %",
                [Text(f"identified: {fractions}")],
                load='pandas.read_csv("{}/tables/points.csv")',
                picture="frontier",
            )
        )

    def points(
        self, variants: Mapping[str, Variant], *, seed: int = 0, progress: Progress = SILENT
    ) -> pd.DataFrame:
        """Result of every variant on one noise-free trajectory per sampling rate and duration.

        All trajectories start from the system's initial state. One row per variant, rate and
        duration. identified: whether the true equations of all states are on the fronts. reason:
        why a variant could not run on so few samples, or an empty string. Raises ValueError if
        there is nothing to run, or if a variant cannot run on the longest and fastest trajectory of
        all: the cause is then not the number of samples.
        """
        # The largest comes first: a variant that cannot run at all fails before the work is done.
        points = sorted(product(self.rates_Hz, self.durations_s), reverse=True)
        assess = partial(_point, self.system, variants, seed=seed, largest=points[:1])
        rows = rows_in_order(self.parallel, assess, points, "trajectory", progress)
        place = {name: k for k, name in enumerate(variants)}
        rows.sort(key=lambda row: (place[row["variant"]], row["rate_Hz"], row["duration_s"]))
        return pd.DataFrame(rows)


def _point(
    system: System,
    variants: Mapping[str, Variant],
    point: tuple[float, float],
    *,
    seed: int,
    largest: list[tuple[float, float]],
) -> list[dict[str, object]]:
    rate_Hz, duration_s = point
    n_samples = round(rate_Hz * duration_s)
    sampled = replace(system, rate_Hz=rate_Hz, duration_s=duration_s)
    rows: list[dict[str, object]] = []
    for name, variant in variants.items():
        # Each variant has its own random stream, so that leaving one out changes no other.
        rng = np.random.default_rng([seed, *name.encode()])
        identified, reason = False, ""
        try:
            if n_samples < 2:
                raise ValueError(f"a trajectory needs two samples: {n_samples} fit in")
            run = sampled.trajectory()
            finding = variant.find([run], system.model.library, rng=rng)
            identified = merits(finding, system)["on_front"] == 1.0
        except ValueError as error:
            if [point] == largest:
                raise
            reason = str(error)
        rows.append(
            {
                "variant": name,
                "rate_Hz": rate_Hz,
                "duration_s": duration_s,
                "n_samples": n_samples,
                "identified": identified,
                "reason": reason,
            }
        )
    return rows
