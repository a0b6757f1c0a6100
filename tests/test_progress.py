"""Stages of long work: who is informed, how bars look, and that results do not change."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.runtime.progress import count_pieces

LIBRARY = ep.polynomial(["x", "y"], degree=2)


@dataclass
class Stage:
    label: str
    unit: str
    total: int | None
    done: int = 0
    over: bool = False


@dataclass
class Recorder:
    """A progress that keeps every stage, in the order in which they began."""

    stages: list[Stage] = field(default_factory=list)

    @contextmanager
    def stage(self, total: int | None, unit: str, label: str = "") -> Iterator[Callable]:
        own = Stage(label, unit, total)
        self.stages.append(own)

        def advance(n_more: int) -> None:
            own.done += n_more

        try:
            yield advance
        finally:
            own.over = True


@pytest.fixture(scope="module")
def prey() -> ep.Trajectory:
    return ep.lotka_volterra().trajectory(noise=0.01, rng=0)


def regression(selection: object = None, **settings: object) -> ep.Regression:
    return ep.Regression(
        ep.Differential(),
        ep.BestSubset(max_terms=2),
        selection or ep.EBIC(),
        ep.Bootstraps(**({"n": 4} | settings)),
    )


def test_a_result_does_not_depend_on_who_watches(prey: ep.Trajectory) -> None:
    watched, alone = (
        ep.discover(prey, LIBRARY, regression(), seed=1, **more)  # type: ignore[arg-type]
        for more in ({"progress": Recorder()}, {})
    )
    np.testing.assert_array_equal(watched.model.coef, alone.model.coef)
    np.testing.assert_array_equal(watched.model.covariance, alone.model.covariance)
    for state in ("x", "y"):
        np.testing.assert_array_equal(watched.scores[state], alone.scores[state])


def test_what_fails_leaves_its_stage() -> None:
    watch = Recorder()
    with pytest.raises(ZeroDivisionError), watch.stage(2, "piece"):
        1 / 0  # noqa: B018
    for _ in (pieces := count_pieces(watch, [1, 2], "piece")):
        break
    pieces.close()
    assert [(each.done, each.over) for each in watch.stages] == [(0, True), (0, True)]
