"""Complete methods, compared on systems with known equations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from typing import Protocol, runtime_checkable

import numpy as np

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.recipe import Finding
from ep2sindy.library.library import Library
from ep2sindy.studies.kinds import Deferred
from ep2sindy.systems.systems import System


@runtime_checkable
class Variant(Protocol):
    """A complete method: trajectories and a library in, supports out; a `Recipe` is one."""

    def find(
        self, runs: Sequence[Trajectory], library: Library, *, rng: np.random.Generator
    ) -> Finding: ...


def built_variants(names: Sequence[str], definitions: Mapping[str, Deferred]) -> dict[str, Variant]:
    """The methods of these names, as `definitions` says; no other is built.

    Raises ValueError for an unknown name, one whose package is not installed, or what has no
    `find`.
    """
    unknown = [name for name in names if name not in definitions]
    if unknown:
        raise ValueError(f"unknown variants {unknown}; there are {list(definitions)}")
    variants = {}
    for name in names:
        if "PySINDy" in definitions[name].settings["_target_"] and find_spec("pysindy") is None:
            raise ValueError(
                f'variants {name!r} needs PySINDy: pip install "ep2sindy[benchmark]", or leave it '
                "out, such as variants=[ours,STLSQ]"
            )
        variant = definitions[name].build()
        if not isinstance(variant, Variant):
            raise ValueError(
                f"definitions.{name} must name a _target_ that has `find`: {variant} came"
            )
        variants[name] = variant
    return variants


def merits(finding: Finding, system: System) -> dict[str, float]:
    """The three figures of merit for one realization, as numbers; NaN where none was selected."""
    truth = {state: frozenset(system.model.terms(state)) for state in system.model.states}
    found = {"on_front": float(all(truth[state] in finding.kept[state] for state in truth))}
    if finding.selected is None:
        return found | {"selected": np.nan, "correct_terms": np.nan}
    chosen = finding.selected
    return found | {
        "selected": float(all(chosen[state] == truth[state] for state in truth)),
        "correct_terms": float(sum(len(chosen[state] & truth[state]) for state in truth)),
    }
