"""How many files of the package a call enters: what a reader has to open to follow it."""

import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType

import pandas as pd

import ep2sindy as ep

PACKAGE = str(Path(ep.__file__).parent)


def files_entered(call: Callable[[], object]) -> set[str]:
    """Paths below ep2sindy/ of all Python functions that a call enters."""
    entered: set[str] = set()

    def watch(frame: FrameType, event: str, argument: object) -> None:
        path = frame.f_code.co_filename
        if event == "call" and path.startswith(PACKAGE):
            entered.add(Path(path).relative_to(PACKAGE).as_posix())

    before = sys.getprofile()
    sys.setprofile(watch)
    try:
        call()
    finally:
        sys.setprofile(before)
    return entered


def test_a_discovery_by_the_default_makes_no_rows() -> None:
    run = ep.lotka_volterra().trajectory(noise=0.02, rng=0).window(0, 300)
    table = pd.DataFrame({"t": run.t, **dict(zip(run.state_names, run.states.T, strict=True))})
    ep.discover(table)  # imports, and kernels that are compiled
    entered = files_entered(lambda: ep.discover(table))
    assert not {f"regression/{name}.py" for name in ("rows", "formulations", "whitening")} & entered
    assert len(entered) <= 45, sorted(entered)  # two of them read the table's names and units


def test_a_refinement_is_followed_through_few_files() -> None:
    prey = ep.lotka_volterra()
    run = prey.trajectory(noise=0.02, rng=0)
    ep.refine(prey.model, [run], window=30, n_windows=4, seed=0)  # imports, and compiles
    entered = files_entered(lambda: ep.refine(prey.model, [run], window=30, n_windows=4, seed=0))
    assert len(entered) <= 24, sorted(entered)
