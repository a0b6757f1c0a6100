"""Execution of independent pieces of work: one after the other, on all cores, or on a cluster.

What keeps finished pieces is in `kept_pieces.py`.
"""

from __future__ import annotations

import os
import pickle
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from threading import RLock
from time import perf_counter
from typing import Any, Protocol, TypeAlias, runtime_checkable

import cloudpickle
from joblib import Parallel, delayed, effective_n_jobs, parallel_config
from joblib.parallel import BACKENDS, get_active_backend

from ep2sindy.runtime.progress import SILENT, Progress, Stage
from ep2sindy.runtime.screen import SAID
from ep2sindy.runtime.threads import one_thread
from ep2sindy.runtime.values import check_positive
from ep2sindy.trust.interruption import end_with
from ep2sindy.trust.user_code import own_packages

# Wall time that the start of processes costs, each with its imports.
START_S = 4.5

Function: TypeAlias = Callable[[Any], Any]  # of a piece
Numbered: TypeAlias = tuple[int, Any]  # the number of a piece, and the piece or its result
Results: TypeAlias = Iterator[Numbered]
Part: TypeAlias = Sequence[int]  # k and n: the k-th of n parts


@runtime_checkable
class Workers(Protocol):
    """Interface of all kinds of workers, which apply a function to every piece.

    `run` yields (number of the piece, result) as results arrive, in any order. Each piece runs on
    one thread, so that a result does not depend on where it was computed. Function, pieces and
    results must be picklable. n_alike: number of pieces if each takes about as long; workers that
    must be started first then save themselves if that takes longer. part: see `Loky`; `run` leaves
    it to `CachedWorkers`.
    """

    @property
    def part(self) -> Part | None: ...

    def run(
        self, function: Function, pieces: Iterable[Any], n_alike: int | None = None
    ) -> Results: ...


def check_part(part: Part | None) -> None:
    """Raise ValueError unless a part is None or [k, n] with 1 <= k <= n."""
    if part is None:
        return
    whole = isinstance(part, list | tuple) and all(type(number) is int for number in part)
    if not (whole and len(part) == 2 and 1 <= part[0] <= part[1]):
        raise ValueError(f"part must be [k, n], the k-th of n parts, such as [1, 4], got {part!r}")


def refuse_part(part: Part | None) -> None:
    """Raise ValueError for a part where no pieces are kept, which are what joins the parts."""
    if part is not None:
        raise ValueError(
            "parts are joined by the pieces that a study keeps for the others, got part="
            f"{[*part]} where none are kept: set parallel.part in +exp=pointwise, parametric, "
            "predict, benchmark, frontier or weak_windows, with keep=true"
        )


def _on_one_thread(function: Function, numbered: Numbered) -> Numbered:
    number, piece = numbered
    with one_thread():
        return number, function(piece)


def collect(
    workers: Workers,
    function: Function,
    pieces: Sequence[Any],
    stage: Stage,
    *,
    size: Callable[[Any], int] = lambda piece: 1,
    tell: Callable[[int, Any], None] = lambda number, result: None,
) -> list[Any]:
    """Compute all pieces and return their results in the order of the pieces.

    stage: a stage of a `Progress`, which receives the size of every finished piece. tell: called
    with the number and the result of every piece as soon as it is done.
    """
    refuse_part(workers.part)
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


def in_worker(code: bytes, parent: int | None, numbered: Numbered) -> Numbered:
    """Result of a piece. parent: the program whose end is the worker's; None for any other worker.

    Workers of a cluster, for example, have been started by somebody else and serve other programs.
    """
    if parent not in (None, os.getpid()):  # joblib runs a worker's nested work in its process
        from tqdm import tqdm

        end_with(parent)
        tqdm.set_lock(RLock())  # the default, a semaphore, causes a warning when the worker ends
    return _on_one_thread(pickle.loads(code), numbered)


def with_its_code(function: Function) -> bytes:
    """Pickle a function with the code of the modules in the folder of the run that configs name."""
    for package in own_packages():
        cloudpickle.register_pickle_by_value(package)
    return cloudpickle.dumps(partial(_unrepeated, frozenset(SAID), function))


def _unrepeated(said: frozenset[str], function: Function, piece: Any) -> Any:
    """Do a piece without saying what the program has said."""
    SAID.update(said)
    return function(piece)


def is_local() -> bool:
    """Whether joblib starts its own processes here, unless a `joblib.parallel_config` says else."""
    return isinstance(get_active_backend()[0], BACKENDS["loky"])


def run_in_joblib(function: Function, pieces: Iterable[Any], *, n_jobs: int | None) -> Results:
    """Results of pieces, by the backend of joblib that is active at the call."""
    # Workers without work end after a while; joblib starts others when work comes again, with this
    # warning, and no piece is lost.
    warnings.filterwarnings("ignore", "A worker stopped while some jobs", UserWarning)
    # Ray's backend returns all results at once. max_nbytes=None, or joblib keeps a copy of every
    # large array on disk.
    as_they_come = get_active_backend()[0].supports_return_generator
    kind = "generator_unordered" if as_they_come else "list"
    workers = Parallel(n_jobs=n_jobs, return_as=kind, max_nbytes=None)
    parent = os.getpid() if is_local() else None
    code, numbered = with_its_code(function), enumerate(pieces)
    return iter(workers(delayed(in_worker)(code, parent, each) for each in numbered))


@dataclass(frozen=True)
class Serial:
    """Workers that compute one part after the other, in this process.

    Parameters
    ----------
    part : (k, n), optional
        See `Loky`.

    Raises
    ------
    ValueError
        If the part is not one of n.
    """

    part: Part | None = None

    def __post_init__(self) -> None:
        check_part(self.part)

    def run(self, function: Function, pieces: Iterable[Any], n_alike: int | None = None) -> Results:
        for numbered in enumerate(pieces):
            yield _on_one_thread(function, numbered)


ONE_BY_ONE = Serial()


@dataclass(frozen=True)
class Loky:
    """Workers in parallel processes on this machine, or of the active backend of joblib.

    A surrounding `joblib.parallel_config` is respected: `with joblib.parallel_config("dask")` sends
    the pieces to the workers of a dask client.

    Parameters
    ----------
    n_jobs : int or None, default -1
        Number of processes. -1 means one per core; None takes the number of the surrounding
        `joblib.parallel_config`, and one without it.
    part : (k, n), optional
        Only the k-th of n parts of the first set of pieces is computed, and kept for the others, as
        by one job of an array of n. The part that finds all others kept continues with all pieces,
        as does a run without a part. Only studies that keep pieces take parts.

    Raises
    ------
    ValueError
        If the number is zero or not whole, or the part is not one of n.
    """

    n_jobs: int | None = -1
    part: Part | None = None

    def __post_init__(self) -> None:
        if self.n_jobs is not None and (type(self.n_jobs) is not int or self.n_jobs == 0):
            raise ValueError(
                f"n_jobs must be a number of processes, or -1 for one per core, got {self.n_jobs!r}"
            )
        check_part(self.part)

    def run(self, function: Function, pieces: Iterable[Any], n_alike: int | None = None) -> Results:
        waiting, n_first, pays = iter(pieces), 0, True
        if is_local():
            saved = 1.0 - 1.0 / effective_n_jobs(self.n_jobs)  # as a fraction of the time of all
            pays = saved > 0.0
            if pays and n_alike is not None:
                n_first, begin = 1, perf_counter()
                yield from ONE_BY_ONE.run(function, islice(waiting, n_first))
                pays = saved * (perf_counter() - begin) * (n_alike - 1) > START_S
        run = partial(run_in_joblib, n_jobs=self.n_jobs) if pays else ONE_BY_ONE.run
        for number, result in run(function, waiting):
            yield number + n_first, result


# The workers of functions that are given none.
SURROUNDING = Loky(n_jobs=None)


# Workers on the machines of a cluster: of dask, and of Ray by its backend of joblib.


@dataclass(frozen=True)
class Dask:
    """Workers of a dask cluster, which are started apart from the program.

    They need the package in the same version, and the program's data files at the same paths. A
    piece whose worker is lost is computed by another one.

    Parameters
    ----------
    address : str, optional
        Of the cluster's scheduler, such as tcp://10.0.0.7:8786.
    scheduler_file : str, optional
        The file in which the scheduler has written its address; give this or the address.
    wait_s : float, default 600.0
        Longest time to wait for the first worker, as it may stand in the queue of a batch system.
    part : (k, n), optional
        See `Loky`.

    Raises
    ------
    ValueError
        If not exactly one of address and scheduler_file is given, or the part is not one of n;
        where work is to be done, if distributed is not installed, or no scheduler or worker is met.
    """

    address: str | None = None
    scheduler_file: str | None = None
    wait_s: float = 600.0
    part: Part | None = None

    def __post_init__(self) -> None:
        check_part(self.part)
        if bool(self.address) == bool(self.scheduler_file):
            raise ValueError(
                "parallel=dask needs parallel.address=tcp://HOST:PORT of a scheduler that runs, or "
                f"parallel.scheduler_file, one of both, got address={self.address!r} and "
                f"scheduler_file={self.scheduler_file!r}; `dask scheduler` starts one"
            )
        check_positive("wait_s", self.wait_s)

    def run(self, function: Function, pieces: Iterable[Any], n_alike: int | None = None) -> Results:
        # Not by joblib's backend: with one thread at the start, as when the first of many workers
        # has just joined, it would do all pieces in this process, and it sends none to later ones.
        numbered = enumerate(pieces)
        with _client(self) as client:
            from distributed import as_completed

            code, sent = with_its_code(function), as_completed(loop=client.loop)

            def send() -> None:
                """Give every thread of the cluster a piece to work on, and one that waits."""
                n_free = 2 * sum(client.ncores().values()) - sent.count()
                for piece in islice(numbered, max(0, n_free)):
                    sent.add(client.submit(in_worker, code, None, piece, pure=False))

            send()
            for future in sent:
                yield future.result()
                send()


@contextmanager
def _client(cluster: Dask) -> Iterator[Any]:
    """A client of a dask cluster that has one worker at least. Raises ValueError if there is none.

    It is not the default client, which would read the chunks of a field on the cluster, too.
    """
    try:
        from distributed import Client, KilledWorker
    except ImportError as error:
        raise ValueError("parallel=dask needs pip install 'ep2sindy[cluster]'") from error
    address, file = cluster.address, cluster.scheduler_file
    place = address or file
    try:
        if file and not Path(file).is_file():
            raise OSError("the file is not there")  # a client would wait for it without end
        client = Client(address, scheduler_file=file, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ValueError(f"a dask scheduler must run at {place}, got: {error}") from error
    with client:
        try:
            client.wait_for_workers(1, timeout=cluster.wait_s)
        except TimeoutError as error:
            raise ValueError(
                f"the dask cluster at {place} must have a worker, got none in {cluster.wait_s:g} s;"
                " start some by `dask worker`, or wait longer, parallel.wait_s"
            ) from error
        try:
            yield client
        except KilledWorker as error:
            raise ValueError(f"a piece must leave its worker alive, got: {error}") from error


@dataclass(frozen=True)
class Ray:
    """Workers of a Ray cluster.

    They need the package in the same version, and the program's data files at the same paths.

    Parameters
    ----------
    address : str, optional
        Of the cluster, such as "auto" or ray://10.0.0.7:10001. None starts one on this machine.
    part : (k, n), optional
        See `Loky`.

    Raises
    ------
    ValueError
        If the part is not one of n; where work is to be done, if ray is not installed, or there is
        no cluster at the address.
    """

    address: str | None = None
    part: Part | None = None

    def __post_init__(self) -> None:
        check_part(self.part)

    def run(self, function: Function, pieces: Iterable[Any], n_alike: int | None = None) -> Results:
        try:
            import ray
            from ray.util.joblib import register_ray
        except ImportError as error:
            raise ValueError("parallel=ray needs pip install 'ep2sindy[ray]'") from error
        try:
            ray.init(self.address, ignore_reinit_error=True, logging_level="error")
        except (ConnectionError, ValueError) as error:
            raise ValueError(f"a Ray cluster must run at {self.address}, got: {error}") from error
        register_ray()
        with parallel_config("ray"):
            results = run_in_joblib(function, pieces, n_jobs=-1)
        yield from results
