"""How far a call walks: files of the package that it enters, counted by a profiler's hook."""

import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType

import pandas as pd

import ep2sindy as ep

PACKAGE = Path(ep.__file__).resolve().parent


def files_entered(call: Callable[[], object]) -> set[str]:
    """Files below ep2sindy/ of whose functions one is entered, compiled kernels among them."""
    entered: set[str] = set()

    def hook(frame: FrameType, event: str, argument: object) -> None:
        if event == "call":
            entered.add(frame.f_code.co_filename)

    before = sys.getprofile()
    sys.setprofile(hook)
    try:
        call()
    finally:
        sys.setprofile(before)
    below = [Path(name) for name in entered if name.startswith(str(PACKAGE))]
    return {str(path.relative_to(PACKAGE)) for path in below}


def test_a_discovery_by_the_default_enters_no_room_of_rows_but_to_compare_terms() -> None:
    run = ep.lotka_volterra().trajectory(noise=0.02, rng=0).window(0, 300)
    table = pd.DataFrame({"t": run.t, **dict(zip(run.state_names, run.states.T, strict=True))})
    ep.discover(table)  # imports, and kernels that are compiled
    entered = files_entered(lambda: ep.discover(table))
    rows = {name for name in entered if name.startswith("regression/")}
    assert rows == {"regression/ambiguity.py", "regression/gram_fits.py"}
    assert len(entered) <= 35, sorted(entered)  # 53 with rows
