"""One thread: what an experiment, a refinement or a discovery computes with."""

import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

import ep2sindy as ep
from ep2sindy.app import main as program
from ep2sindy.data.coerce import DiscoveryProblem
from ep2sindy.regression.front import Fronts
from ep2sindy.runtime.progress import Progress
from ep2sindy.runtime.threads import NUMBERS, one_thread
from ep2sindy.selection.criteria import Basis, Decision

PREY = ep.lotka_volterra()


@pytest.fixture(autouse=True)
def two_threads() -> Iterator[None]:
    import torch  # takes a second and more: for those alone who run these tests

    before = torch.get_num_threads()
    torch.set_num_threads(2)
    with threadpool_limits(2):
        yield
    torch.set_num_threads(before)


def threads() -> tuple[int, int]:
    """Of NumPy's libraries, the most, and of PyTorch."""
    import torch

    blas = (pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas")
    return max(blas), torch.get_num_threads()


@dataclass(frozen=True)
class WatchedChoice:
    label: ClassVar[str] = "EBIC"
    basis: ClassVar[Basis] = "rows"
    seen: list[tuple[int, int]] = field(default_factory=list)

    def decide(self, fronts: Fronts, task: DiscoveryProblem, *, progress: Progress) -> Decision:
        self.seen.append(threads())
        return ep.EBIC().decide(fronts, task, progress=progress)


def test_on_one_thread_and_then_on_as_many_as_before() -> None:
    assert threads() == (2, 2)
    with one_thread():
        assert threads() == (1, 1)
    assert threads() == (2, 2)
    with pytest.raises(ValueError, match="no"), one_thread():
        raise ValueError("no")
    assert threads() == (2, 2)


def test_the_last_to_leave_gives_the_threads_back() -> None:
    first, second = one_thread(), one_thread()
    first.__enter__()
    second.__enter__()  # sees one thread, and must not take it for what was there before
    first.__exit__(None, None, None)
    assert threads()[0] == 1
    second.__exit__(None, None, None)
    assert threads() == (2, 2)


def test_a_refinement_runs_on_one_thread() -> None:
    from ep2sindy.refinement.methods.multiple_shooting import MultipleShooting
    from ep2sindy.refinement.problem import RefinementFit, RefinementProblem
    from ep2sindy.refinement.refine import refine

    @dataclass(frozen=True)
    class WatchedFit(MultipleShooting):
        seen: list[tuple[int, int]] = field(default_factory=list)

        def fit(self, problem: RefinementProblem) -> RefinementFit:
            self.seen.append(threads())
            return super().fit(problem)

    method = WatchedFit()
    rng = np.random.default_rng(0)
    refine(PREY.model, [PREY.trajectory()], window=40, n_windows=3, method=method, seed=rng)
    assert method.seen
    assert set(method.seen) == {(1, 1)}
    assert threads() == (2, 2)


def test_a_discovery_runs_on_one_thread() -> None:
    rule = WatchedChoice()
    ep.discover(PREY.trajectory(), method=ep.Regression(ep.WeightedWeak(), selection=rule))
    assert rule.seen == [(1, 1)]
    assert threads() == (2, 2)


@pytest.mark.slow
def test_a_process_starts_on_one_thread_whatever_the_environment_says() -> None:
    code = (
        "from ep2sindy.runtime.threads import start_on_one_thread as start; start()\n"
        "import numpy, scipy.linalg, torch\n"
        "from threadpoolctl import threadpool_info\n"
        "print({p['num_threads'] for p in threadpool_info()}, torch.get_num_threads())"
    )
    env = {**os.environ, **dict.fromkeys(NUMBERS, "2")}
    found = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True)
    assert found.stdout == "{1} 1\n", found.stderr


def test_the_program_starts_on_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in NUMBERS:
        monkeypatch.setenv(name, "2")
    monkeypatch.setattr(sys, "argv", ["ep2sindy", "compare"])
    with pytest.raises(SystemExit):
        program.main()
    assert [os.environ[name] for name in NUMBERS] == ["1"] * len(NUMBERS)
