"""Workers on the machines of a cluster: of dask, and of Ray by its backend of joblib."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

from joblib import parallel_config

from ep2sindy.runtime.parallel import (
    Function,
    Part,
    Results,
    check_part,
    in_worker,
    run_in_joblib,
    with_its_code,
)
from ep2sindy.runtime.values import check_positive


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
        See `ep.parallel.Loky`.

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
        See `ep.parallel.Loky`.

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
