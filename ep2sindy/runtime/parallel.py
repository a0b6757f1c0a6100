"""Execution of independent pieces of work: one after the other, or on all cores."""

from __future__ import annotations

import os
import pickle
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from functools import partial
from itertools import count, islice
from pathlib import Path
from threading import RLock
from time import perf_counter
from typing import Any, Protocol, TypeAlias, runtime_checkable

import cloudpickle
from joblib import Memory, Parallel, delayed, effective_n_jobs

from ep2sindy.runtime.progress import SILENT, Progress
from ep2sindy.runtime.screen import SAID
from ep2sindy.runtime.threads import one_thread
from ep2sindy.trust.interruption import end_with
from ep2sindy.trust.user_code import own_packages

# Wall time that the start of processes costs, each with its imports.
START_S = 4.5

Function: TypeAlias = Callable[[Any], Any]  # of a piece
Numbered: TypeAlias = tuple[int, Any]  # the number of a piece, and the piece or its result
Results: TypeAlias = Iterator[Numbered]


@runtime_checkable
class Workers(Protocol):
    """Interface of all kinds of workers, which apply a function to every piece.

    `run` yields (number of the piece, result) as results arrive, in any order. Each piece runs on
    one thread, so that a result does not depend on where it was computed. Function, pieces and
    results must be picklable.
    """

    def run(self, function: Function, pieces: Iterable[Any]) -> Results: ...


def _on_one_thread(function: Function, numbered: Numbered) -> Numbered:
    number, piece = numbered
    with one_thread():
        return number, function(piece)


def collect(
    workers: Workers,
    function: Function,
    pieces: Sequence[Any],
    stage: AbstractContextManager[Callable[[int], None]],
    *,
    size: Callable[[Any], int] = lambda piece: 1,
    tell: Callable[[int, Any], None] = lambda number, result: None,
) -> list[Any]:
    """Compute all pieces and return their results in the order of the pieces.

    stage: a stage of a `Progress`, which receives the size of every finished piece. tell: called
    with the number and the result of every piece as soon as it is done.
    """
    results: dict[int, Any] = {}
    with stage as advance:
        for number, result in workers.run(function, pieces):
            results[number] = result
            tell(number, result)
            advance(size(pieces[number]))
    return [results[number] for number in range(len(pieces))]


def rows_in_order(
    workers: Workers,
    function: Callable[[Any], Sequence[Any]],
    pieces: Sequence[Any],
    unit: str,
    progress: Progress = SILENT,
) -> list[Any]:
    """Compute the rows of every piece and return all rows in the order of the pieces.

    unit: noun for a piece.
    Raises ValueError if there is no row at all.
    """
    found = collect(workers, function, pieces, progress.stage(len(pieces), unit))
    if not any(found):
        raise ValueError(
            f"there must be something to run, got {len(found)} pieces, without a row; leave no "
            "list of settings empty"
        )
    return [row for rows in found for row in rows]


def _in_worker(code: bytes, parent: int, numbered: Numbered) -> Numbered:
    from tqdm import tqdm

    if os.getpid() != parent:  # inside a worker, joblib runs nested work in the same process
        end_with(parent)
        tqdm.set_lock(RLock())  # the default, a semaphore, causes a warning when the worker ends
    return _on_one_thread(pickle.loads(code), numbered)


def _with_its_code(function: Function) -> bytes:
    """Pickle a function with the code of the modules in the folder of the run that configs name."""
    for package in own_packages():
        cloudpickle.register_pickle_by_value(package)
    return cloudpickle.dumps(partial(_unrepeated, frozenset(SAID), function))


def _unrepeated(said: frozenset[str], function: Function, piece: Any) -> Any:
    """Do a piece without saying what the program has said."""
    SAID.update(said)
    return function(piece)


@dataclass(frozen=True)
class Serial:
    """Workers that compute one part after the other, in this process."""

    def run(self, function: Function, pieces: Iterable[Any]) -> Results:
        for numbered in enumerate(pieces):
            yield _on_one_thread(function, numbered)


ONE_BY_ONE = Serial()


@dataclass(frozen=True)
class Loky:
    """Workers in parallel processes on this machine.

    Parameters
    ----------
    n_jobs : int, default -1
        Number of processes. -1 means one per core.

    Raises
    ------
    ValueError
        If the number is zero or not whole.
    """

    n_jobs: int = -1

    def __post_init__(self) -> None:
        if type(self.n_jobs) is not int or self.n_jobs == 0:
            raise ValueError(
                f"n_jobs must be a number of processes, or -1 for one per core, got {self.n_jobs!r}"
            )

    def run(self, function: Function, pieces: Iterable[Any]) -> Results:
        if effective_n_jobs(self.n_jobs) == 1:
            yield from ONE_BY_ONE.run(function, pieces)
            return
        # Workers without work end after a while; joblib starts others when work comes again, with
        # this warning, and no piece is lost.
        warnings.filterwarnings("ignore", "A worker stopped while some jobs", UserWarning)
        # max_nbytes=None, or joblib would keep a copy of every large array on disk.
        workers = Parallel(n_jobs=self.n_jobs, return_as="generator_unordered", max_nbytes=None)
        code, numbered = _with_its_code(function), enumerate(pieces)
        yield from workers(delayed(_in_worker)(code, os.getpid(), each) for each in numbered)


Once = Callable[[Callable[[], Any]], Any]  # does a piece of work, or reads its result back


def at_once(function: Callable[[], Any]) -> Any:
    """Do a piece of work, and keep nothing."""
    return function()


@dataclass(frozen=True, eq=False)
class CachedWorkers:
    """Workers whose finished pieces are kept in a folder, and read back by a run that continues.

    A piece is named by the number of the call of `run` that it belongs to, and by its own: the
    calls must come in the same order in every run of the same settings. folder: None keeps nothing.
    """

    workers: Workers
    folder: Path | None
    _calls: Iterator[int] = field(default_factory=count)

    def run(self, function: Function, pieces: Iterable[Any]) -> Results:
        return self.workers.run(self.keeping(function), enumerate(pieces))

    def once(self, function: Callable[[], Any]) -> Any:
        """The result of one piece of work that is done in this process."""
        return self.keeping(lambda _: function())((0, None))

    def keeping(self, function: Function) -> Callable[[Numbered], Any]:
        """The function of numbered pieces that does each, or reads its result back."""
        return partial(_kept_piece, self.folder, next(self._calls), function)


def _kept_piece(folder: Path | None, call: int, function: Function, numbered: Numbered) -> Any:
    number, piece = numbered
    return kept(folder, (call, number), function, piece) if folder else function(piece)


def kept(folder: Path, piece: tuple[int, int], function: Function, value: Any) -> Any:
    """`function(value)`, or what it returned when this piece was done before.

    piece: numbers of the piece's call and of the piece in it.
    """
    return Memory(folder, verbose=0).cache(_done, ignore=["function", "value"])(
        piece, function, value
    )


def _done(piece: tuple[int, int], function: Function, value: Any) -> Any:
    return function(value)


def run_alike(
    workers: Workers, function: Function, pieces: Iterable[Any], n_pieces: int
) -> Results:
    """Run pieces of which each takes about as long; processes start only if they save time.

    The first piece is then done in this process, and the others too if they would take less time
    than the start of the processes.
    """
    if isinstance(workers, CachedWorkers):
        kept = workers.keeping(function)
        yield from run_alike(workers.workers, kept, enumerate(pieces), n_pieces)
        return
    waiting = iter(pieces)
    n_first = 1 if isinstance(workers, Loky) else 0
    begin = perf_counter()
    yield from ONE_BY_ONE.run(function, islice(waiting, n_first))
    if isinstance(workers, Loky):
        rest_s = (perf_counter() - begin) * (n_pieces - 1)
        saved_s = rest_s * (1.0 - 1.0 / effective_n_jobs(workers.n_jobs))
        workers = workers if saved_s > START_S else ONE_BY_ONE
    for number, result in workers.run(function, waiting):
        yield number + n_first, result
