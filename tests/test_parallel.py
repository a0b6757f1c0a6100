import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import psutil
import pytest
from joblib.parallel import ThreadingBackend
from threadpoolctl import threadpool_info

import ep2sindy as ep
from ep2sindy.runtime import parallel
from ep2sindy.runtime.parallel import SURROUNDING, Loky, Serial, Workers, collect, rows_in_order
from ep2sindy.runtime.progress import as_progress
from tests.test_pointwise import parabolas, searching

PATIENCE_S = 300.0  # for what comes at once on an idle machine: only what hangs is longer
PIECES = [np.arange(k, dtype=np.float64) for k in range(7)]


def total(values: np.ndarray) -> float:
    return float(values.sum())


def n_threads(_: object) -> int:
    np.ones((2, 2)) @ np.ones((2, 2))
    return max(pool["num_threads"] for pool in threadpool_info())


class Backwards(Serial):
    """Results come in the order that is farthest from that of the pieces."""

    def run(
        self, function: Callable[[Any], Any], pieces: Iterable[Any], n_alike: int | None = None
    ) -> Iterator[tuple[int, Any]]:
        return reversed(list(super().run(function, pieces)))


def repeated(piece: int) -> list[int]:
    return piece * [piece]


def fails_on_three(piece: int) -> int:
    if piece == 3:
        raise ValueError("got three")
    return piece


@pytest.fixture(params=["serial", "loky"])
def workers(request: pytest.FixtureRequest) -> Workers:
    return Serial() if request.param == "serial" else Loky(n_jobs=2)


def test_every_piece_is_done_once_and_keeps_its_number(workers: Workers) -> None:
    found = dict(workers.run(total, iter(PIECES)))
    assert found == {k: piece.sum() for k, piece in enumerate(PIECES)}


def test_rows_come_in_the_order_of_their_pieces() -> None:
    advances: list[int] = []
    rows = rows_in_order(Backwards(), repeated, [3, 0, 2], "piece", as_progress(advances.append))
    assert rows == [3, 3, 3, 2, 2]
    assert advances == [1, 1, 1]
    with pytest.raises(ValueError, match="there must be something to run, got 1 pieces"):
        rows_in_order(Serial(), repeated, [0], "piece")


def test_results_come_in_the_order_of_their_pieces_and_are_told_as_they_come() -> None:
    advanced: list[int] = []
    told: list[tuple[int, list[int]]] = []
    results = collect(
        Backwards(),
        repeated,
        [3, 0, 2],
        nullcontext(advanced.append),
        size=lambda piece: 10 * piece,
        tell=lambda number, result: told.append((number, result)),
    )
    assert results == [[3, 3, 3], [], [2, 2]]
    assert told == [(2, [2, 2]), (1, []), (0, [3, 3, 3])]
    assert advanced == [20, 0, 30]


def test_a_piece_has_one_thread(workers: Workers) -> None:
    assert set(dict(workers.run(n_threads, range(2))).values()) == {1}


def test_the_error_of_a_piece_arrives(workers: Workers) -> None:
    with pytest.raises(ValueError, match="got three"):
        list(workers.run(fails_on_three, range(6)))


def test_no_pieces_are_no_results(workers: Workers) -> None:
    assert list(workers.run(total, [])) == []


def test_large_pieces_are_not_kept_on_disk(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("JOBLIB_TEMP_FOLDER", str(tmp_path))
    sizes = []
    pieces = (np.full(500_000, float(k)) for k in range(4))
    for _ in Loky(n_jobs=2).run(total, pieces):
        sizes.append(sum(path.stat().st_size for path in tmp_path.rglob("*.pkl")))
    assert max(sizes) == 0


def process_of(piece: int) -> tuple[int, int]:
    return piece, os.getpid()


def test_pieces_that_are_alike_leave_this_process_only_where_it_pays(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for start_s, leave in ((-1.0, True), (np.inf, False)):
        monkeypatch.setattr(parallel, "START_S", start_s)
        found = dict(Loky(n_jobs=2).run(process_of, [5, 6, 7], n_alike=3))
        assert [found[k][0] for k in range(3)] == [5, 6, 7]
        assert found[0][1] == os.getpid()
        assert all((found[k][1] != os.getpid()) == leave for k in (1, 2))
    assert not list(Loky(n_jobs=2).run(process_of, [], n_alike=0))


@pytest.mark.parametrize("workers", [SURROUNDING, Loky(n_jobs=2)])
def test_a_surrounding_config_of_joblib_says_where_pieces_go(workers: Workers) -> None:
    with joblib.parallel_config("threading", n_jobs=2):
        found = dict(workers.run(process_of, [5, 6, 7], n_alike=3))
    assert found == {k: (5 + k, os.getpid()) for k in range(3)}


def test_what_is_given_no_workers_follows_the_config_of_joblib() -> None:
    """Blocks of a field, and operating points."""
    where = Recorded()
    joblib.register_parallel_backend("recorded", lambda: where)
    runs = [ep.lotka_volterra(a=a).trajectory() for a in (0.5, 0.8)]
    points = [replace(run, parameters={"a": k}) for k, run in enumerate(runs)]
    with joblib.parallel_config("recorded", n_jobs=2):
        ep.pointwise(parabolas(), searching(), block_points=3)
        n_blocks = where.n_submitted
        ep.discover(points, method=ep.Regression())
    assert (n_blocks, where.n_submitted) == (4, 6)
    ep.pointwise(parabolas(), searching(), block_points=3)
    assert where.n_submitted == 6


class Recorded(ThreadingBackend):
    """Threads that count the pieces which they are given."""

    n_submitted = 0

    def submit(self, func: Any, callback: Any = None) -> Any:
        self.n_submitted += 1
        return super().submit(func, callback)


@pytest.mark.parametrize("part", [[0, 2], [3, 2], [1], [1.0, 2], "12", [True, 2]])
def test_a_part_is_one_of_n(part: Any) -> None:
    with pytest.raises(ValueError, match=r"part must be \[k, n\], the k-th of n parts"):
        Serial(part=part)


def test_a_part_needs_pieces_that_are_kept() -> None:
    with pytest.raises(ValueError, match=r"got part=\[1, 2\] where none are kept"):
        collect(Serial(part=[1, 2]), total, PIECES, nullcontext(lambda n: None))
    with pytest.raises(ValueError, match=r"got part=\[2, 2\] where none are kept"):
        ep.pointwise(parabolas(), searching(), workers=Loky(part=[2, 2]))


WITHIN = """
import threading
from ep2sindy.runtime.parallel import Loky

def n_watches(piece):
    return sum("_watch" in thread.name for thread in threading.enumerate())

def nested(piece):
    return list(Loky(2).run(n_watches, range(piece)))

if __name__ == "__main__":
    print(sorted(Loky(1).run(n_watches, range(2))), sorted(Loky(2).run(nested, range(2))))
"""


def test_pieces_on_one_core_and_in_workers_come_to_their_end(tmp_path: Path) -> None:
    """Where there are no workers, the run itself took its own parent for a run that had gone.

    A process is watched from within if it is a worker, and once: what it works on in itself adds
    no watch, which would end it.
    """
    script = tmp_path / "run.py"
    script.write_text(WITHIN)
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=True)
    assert done.stdout == "[(0, 0), (1, 0)] [(0, []), (1, [(0, 1)])]\n"


KILLED = """
import os, signal
from ep2sindy.trust.interruption import end_as_interrupted
from ep2sindy.runtime.parallel import Loky

def endless(piece):
    PREPARATION
    os.write(1, f"{os.getpid()}\\n".encode())
    WORK

if __name__ == "__main__":
    end_as_interrupted()
    try:
        list(Loky(2).run(endless, range(2)))
    except KeyboardInterrupt as error:
        print(f"interrupted by {error}", flush=True)
"""

# For hours, in a compiled call, which is compiled before it counts.
COMPILED = """
    import numpy as np
    from ep2sindy.regression.searches import BestSubset
    columns = np.random.default_rng(0).standard_normal((99, 60))
    BestSubset(max_terms=1).supports(np.eye(2), np.ones(2), 2.0)
"""
COMPUTING = "BestSubset(max_terms=20).supports(columns.T @ columns, np.ones(60), 1e9)"
WORK = {"waiting": ("", "signal.pause()"), "computing": (COMPILED.strip(), COMPUTING)}


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="signals of POSIX")
@pytest.mark.parametrize(
    ("work", "name"),
    [
        ("waiting", "SIGTERM"),
        ("waiting", "SIGKILL"),
        pytest.param("waiting", "SIGHUP", marks=pytest.mark.slow),
        pytest.param("computing", "SIGKILL", marks=pytest.mark.slow),
    ],
)
def test_workers_end_with_their_run(tmp_path: Path, name: str, work: str) -> None:
    """A worker is in its work when it next looks at its parent: it has said so just before."""
    preparation, endless = WORK[work]
    script = tmp_path / "run.py"
    script.write_text(KILLED.replace("PREPARATION", preparation).replace("WORK", endless))
    with subprocess.Popen(
        [sys.executable, script],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        # nohup, under which tests may run, has SIGHUP ignored, and that is inherited.
        preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL),
    ) as run:
        assert run.stdout is not None
        workers = [psutil.Process(int(run.stdout.readline())) for _ in range(2)]
        run.send_signal(getattr(signal, name))
        _, alive = psutil.wait_procs(workers, timeout=PATIENCE_S)
        for each in alive:
            each.kill()
        printed = run.stdout.read()
    assert not alive
    assert printed == ("" if name == "SIGKILL" else f"interrupted by {name}\n")
