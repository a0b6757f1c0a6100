"""Independent pieces of work: one after the other, on all cores, or on a cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Any, Protocol, runtime_checkable

from joblib import Parallel, delayed
from threadpoolctl import threadpool_limits

# Pieces handed to a cluster ahead of their turn, per worker: they queue there with their data.
AHEAD = 2


@runtime_checkable
class Workers(Protocol):
    """What the alternatives share: apply a function to every piece, results as they come.

    Yields (number of the piece, result), in any order. Each piece runs on one thread, so that a
    result does not depend on where it was computed. Function, pieces and results must pickle.
    """

    def run(
        self, function: Callable[[Any], Any], pieces: Iterable[Any]
    ) -> Iterator[tuple[int, Any]]: ...


def _on_one_thread(function: Callable[[Any], Any], numbered: tuple[int, Any]) -> tuple[int, Any]:
    number, piece = numbered
    with threadpool_limits(limits=1):
        return number, function(piece)


@dataclass(frozen=True)
class Serial:
    """One piece after the other, in this process."""

    def run(
        self, function: Callable[[Any], Any], pieces: Iterable[Any]
    ) -> Iterator[tuple[int, Any]]:
        for numbered in enumerate(pieces):
            yield _on_one_thread(function, numbered)


ONE_BY_ONE = Serial()


@dataclass(frozen=True)
class Loky:
    """Pieces side by side in processes of this machine. n_jobs: how many; -1, one per core."""

    n_jobs: int = -1

    def __post_init__(self) -> None:
        if type(self.n_jobs) is not int or self.n_jobs == 0:
            raise ValueError(
                f"n_jobs must be a number of processes, or -1 for one per core: {self.n_jobs!r} "
                "came"
            )

    def run(
        self, function: Callable[[Any], Any], pieces: Iterable[Any]
    ) -> Iterator[tuple[int, Any]]:
        workers = Parallel(n_jobs=self.n_jobs, return_as="generator_unordered")
        yield from workers(delayed(_on_one_thread)(function, each) for each in enumerate(pieces))


@dataclass(frozen=True)
class Dask:
    """Pieces on the workers of a running dask scheduler, such as "tcp://10.0.0.1:8786".

    A piece whose worker dies is given to another, as often as the scheduler allows (three times,
    unless it was told otherwise). Workers need this package, and see the same files under the
    same paths. Needs the extra `cluster`.
    Raises OSError when nobody answers at the address within timeout_s.
    """

    address: str
    timeout_s: float = 10.0

    def run(
        self, function: Callable[[Any], Any], pieces: Iterable[Any]
    ) -> Iterator[tuple[int, Any]]:
        distributed = _distributed()
        try:
            client = distributed.Client(self.address, timeout=self.timeout_s)
        except (OSError, ValueError) as error:
            raise OSError(
                f"a dask scheduler must answer at {self.address!r} within {self.timeout_s:g} s: "
                f"{error}; start one with `dask scheduler`, or choose parallel=loky"
            ) from error
        with client:
            yield from self._run(client, distributed.as_completed, function, pieces)

    def _run(
        self,
        client: Any,
        as_completed: Callable,
        function: Callable[[Any], Any],
        pieces: Iterable[Any],
    ) -> Iterator[tuple[int, Any]]:
        waiting = enumerate(pieces)

        def submitted(count: int) -> list[Any]:
            return [
                client.submit(_on_one_thread, function, each, pure=False)
                for each in islice(waiting, count)
            ]

        n_workers = max(1, len(client.scheduler_info()["workers"]))
        running = as_completed(submitted(AHEAD * n_workers))
        for future in running:
            result = future.result()
            future.release()
            for following in submitted(1):
                running.add(following)
            yield result


def _distributed() -> Any:
    try:
        import distributed
    except ImportError as error:
        raise ValueError(
            "parallel=dask needs dask.distributed: pip install 'ep2sindy[cluster]'"
        ) from error
    return distributed
