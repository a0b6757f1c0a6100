"""The identification frontier: how fast and how long one must sample to find known equations.

Source: the thesis, appendix, III-B.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import pandas as pd

from ep2sindy.machine.parallel import ONE_BY_ONE, Workers
from ep2sindy.studies.variants import Variant, judged
from ep2sindy.synthetic.systems import System


def identification_frontier(
    system: System,
    variants: Mapping[str, Variant],
    *,
    rates_Hz: Sequence[float],
    durations_s: Sequence[float],
    workers: Workers = ONE_BY_ONE,
    seed: int = 0,
    progress: Callable[[int], None] = lambda n_done: None,
) -> pd.DataFrame:
    """Every variant on one noise-free trajectory per sampling rate and duration.

    All trajectories start from the system's initial state. One row per variant, rate and
    duration: n_samples, identified (is the whole system on the fronts), and reason, why a variant
    could not run on so few samples, or an empty string.
    Raises ValueError for nothing to run, and where a variant cannot run on the longest and
    fastest of all: that is no matter of samples.
    """
    if not (variants and len(rates_Hz) and len(durations_s)):
        raise ValueError(
            "a frontier needs a variant, a rate and a duration at least: "
            f"variants={list(variants)}, rates_Hz={list(rates_Hz)}, durations_s={list(durations_s)}"
        )
    # The largest comes first: a variant that cannot run at all fails before the work is done.
    points = sorted(((r, d) for r in rates_Hz for d in durations_s), reverse=True)
    largest = (max(rates_Hz), max(durations_s))
    judge = partial(_point, system, variants, seed=seed, largest=largest)
    rows = []
    for n_done, (_, found) in enumerate(workers.run(judge, points), start=1):
        rows += found
        progress(n_done)
    table = pd.DataFrame(rows)
    table["variant"] = pd.Categorical(table["variant"], categories=list(variants), ordered=True)
    order = ["variant", "rate_Hz", "duration_s"]
    return table.sort_values(order, ignore_index=True).astype({"variant": str})


def _point(
    system: System,
    variants: Mapping[str, Variant],
    point: tuple[float, float],
    *,
    seed: int,
    largest: tuple[float, float],
) -> list[dict[str, object]]:
    rate_Hz, duration_s = point
    n_samples = round(rate_Hz * duration_s)
    sampled = replace(system, rate_Hz=rate_Hz, duration_s=duration_s)
    truth = {state: frozenset(system.model.terms(state)) for state in system.model.states}
    rows: list[dict[str, object]] = []
    for name, variant in variants.items():
        # A stream of its own, so that leaving a variant out changes no other.
        rng = np.random.default_rng([seed, *name.encode()])
        identified, reason = False, ""
        try:
            if n_samples < 2:
                raise ValueError(f"a trajectory needs two samples: {n_samples} fit in")
            run = sampled.trajectory()
            finding = variant.find([run], system.model.library, rng=rng)
            identified = judged(finding, truth)["on_front"] == 1.0
        except ValueError as error:
            if point == largest:
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
