"""The equations of the thesis's Tables I to III: are they selected here, and how do they fit?

Each table holds equations of one to three terms in one library. Those of two terms are the thesis's
models, Eqs. 18, 20 and 21. Libraries, search and data are those of `+exp=breathing`, and settings
of that experiment may follow, such as data=NAME or search=adaptive_lasso. A second table counts,
over the six points of the thesis's Table V, at how many an equation of two terms is selected.

    python -m benchmarks.thesis
"""

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from hydra import compose, initialize_config_dir

from ep2sindy.app.arguments import mend
from ep2sindy.app.schema import study_of
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.discover import discover
from ep2sindy.discovery.result import Discovery
from ep2sindy.regression.front import fit_support
from ep2sindy.studies.libraries import Study

CONF = Path(__file__).resolve().parents[1] / "conf"
ZONES = ("downstream", "channel")
CHANNEL_M = 0.025
# Voltage (V), mass flow (mg/s) and the speed of the neutrals (m/s); the first is the main one.
POINTS = [(300, 5, 338), (200, 5, 320), (300, 2, 195), (300, 4, 338), (300, 6, 338), (400, 5, 338)]
# By library: table, and terms of each equation by state, with the thesis's R2. Left out is what the
# scan does not tell: R2 in Table III; the ions' equation of one term, in n_n^2 or n_i^2; and the
# neutrals' of one and three terms in Table III.
EQUATIONS: Mapping[str, tuple[str, Mapping[str, Mapping[str, str]]]] = {
    "simple": (
        "I",
        {
            "n_i": {"n_i, n_i*n_n": "0.63", "n_i, n_i*n_n, n_i^2": "0.69"},
            "n_n": {"n_i*n_n": "-2.56", "n_n, n_i*n_n": "0.85", "n_n, n_i*n_n, n_n^2": "0.88"},
        },
    ),
    "ionization": (
        "II",
        {
            "n_i": {"n_i, n_i*n_n*R_ion": "0.92", "n_i*n_n*R_ion, n_i*n_n, n_i*R_ion": "0.95"},
            "n_n": {"n_i^2": "-0.69", "1, n_i*n_n*R_ion": "0.88", "1, n_i*n_n*R_ion, n_n": "0.94"},
        },
    ),
    "velocity": (
        "III",
        {
            "n_i": {"n_i*u_iz, n_i*n_n*R_ion": "-", "n_i*u_iz, n_i*n_n*R_ion, n_i*n_n": "-"},
            "n_n": {"1, n_i*n_n*R_ion": "-"},
        },
    ),
}


def discoveries(overrides: Sequence[str]) -> tuple[dict[str, Discovery], Trajectory]:
    """What `+exp=breathing` finds by library, and the record of the last library's variables."""
    given = ["+exp=breathing", "sustained=none", "forecasts=0", *map(mend, overrides)]
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("config", given)
    study = study_of(Study, config)
    field, sampling = study.source.field(), study.source.trajectory
    streams = np.random.default_rng(config.seed).spawn(len(study.libraries))
    found = {}
    for (name, case), rng in zip(study.libraries.items(), streams, strict=True):
        library = case.library(field, sampling)
        run = sampling.trajectory(field, inputs=study.source.inputs([library]), label=name)
        found[name] = discover([run], library, case.method(study.method), seed=rng, decimate=None)
    return found, run


def verdict(found: Discovery, state: str, terms: Sequence[str]) -> tuple[str, float]:
    """Whether the search selects these terms or has them as the best of their number; their R2."""
    front = found.fronts[state]
    r2 = fit_support(front.rows, state, terms).r2
    if set(found.chosen[state].terms) == set(terms):
        return "selected", r2
    best = [set(each.terms) for each in front.candidates]
    return "on the front" if set(terms) in best else "no", r2


def tell_tables(found: Sequence[Mapping[str, Discovery]]) -> None:
    """A line for every equation. found: by library, for every zone."""
    print(f"| table | equation and terms | R², thesis | {' | R² | '.join(ZONES)} | R² |")
    print("|---|---|---|---|---|---|---|")
    for name, (table, states) in EQUATIONS.items():
        for state, equations in states.items():
            for text, published in equations.items():
                cells = [verdict(each[name], state, text.split(", ")) for each in found]
                words = " | ".join(f"{word} | {r2:.2f}" for word, r2 in cells)
                print(f"| {table} | {state}': `{text}` | {published} | {words} |", flush=True)


def tell_points(overrides: Sequence[str]) -> None:
    """A line for every equation of two terms: at how many points it is selected, by zone."""
    places = ("voltage", "mass_flow_mg_s", "neutral_speed")
    counts: dict[str, list[int]] = {}
    for number, zone in enumerate(ZONES):
        for point in POINTS:
            at = [f"data.operating_point.{k}={v}.0" for k, v in zip(places, point, strict=True)]
            found, _ = discoveries([f"trajectory.zone.z={zone}", *at, *overrides])
            for name, (table, states) in EQUATIONS.items():
                for state, equations in states.items():
                    for text in (text for text in equations if text.count(",") == 1):
                        count = counts.setdefault(f"| {table} | {state}': `{text}` |", [0, 0])
                        word, _ = verdict(found[name], state, text.split(", "))
                        count[number] += word == "selected"
    for line, count in counts.items():
        print(line, *(f"{n} of {len(POINTS)} |" for n in count))


def main() -> None:
    given = sys.argv[1:]
    both = [discoveries([f"trajectory.zone.z={zone}", *given]) for zone in ZONES]
    tell_tables([found for found, _ in both])
    for zone, (_, run) in zip(ZONES, both, strict=True):
        means = dict(zip(run.input_names, run.inputs.mean(axis=0), strict=True))
        rates = f"u_iz/L {means['u_iz'] / CHANNEL_M:.3g} 1/s, R_ion {means['R_ion']:.3g} m^3/s"
        print(f"means of Eq. 19, {zone}: {rates}")
    if not any(each.startswith("data") for each in given):
        tell_points(given)


if __name__ == "__main__":
    main()
