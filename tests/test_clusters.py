"""Workers that were started apart from the program: a scheduler and two workers of dask; Ray."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import joblib
import pytest

import ep2sindy as ep
from ep2sindy.runtime.kept_pieces import CachedWorkers, KeptPieces
from ep2sindy.runtime.parallel import Serial
from tests.programs import ROOT
from tests.test_pointwise import bytes_of, noisy, searching

dask = pytest.importorskip("dask")
pytest.importorskip("distributed")


NOWHERE = "tcp://127.0.0.1:9"


@dataclass(frozen=True)
class Cluster:
    """A scheduler with workers, each a process of one thread."""

    address: str
    scheduler_file: str
    workers: list[subprocess.Popen]


@contextmanager
def cluster_in(folder: Path) -> Iterator[Cluster]:
    """A cluster of dask; its workers start in the folder, and keep the user's cache in it."""
    file = folder / "scheduler.json"
    modules = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
    environment = os.environ | {"PYTHONPATH": modules, "EP2SINDY_CACHE": str(folder / "workers")}
    start = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--port=0", "--host=127.0.0.1"]
    serve = [sys.executable, "-m", "distributed.cli.dask_worker", "--nthreads=1", "--no-nanny"]
    with ExitStack() as ends, (folder / "cluster.log").open("w") as log:

        def begin(command: list[str]) -> subprocess.Popen:
            options = [f"--scheduler-file={file}", "--no-dashboard"]
            process = subprocess.Popen(
                [*command, *options], cwd=folder, env=environment, stdout=log, stderr=log
            )
            ends.callback(process.wait)
            ends.callback(process.kill)
            return process

        scheduler = begin(start)
        workers = [begin(serve) for _ in range(2)]
        while not (file.exists() and file.read_text()):
            assert scheduler.poll() is None
        yield Cluster(json.loads(file.read_text())["address"], str(file), workers)


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    with cluster_in(tmp_path_factory.mktemp("cluster")) as running:
        yield running


@pytest.fixture(scope="module")
def serial_bytes() -> dict[str, bytes]:
    return bytes_of(ep.pointwise(noisy(), searching(), workers=Serial()))


def test_a_cluster_is_named_by_one_of_two_ways() -> None:
    for given in ({}, {"address": "tcp://here:1", "scheduler_file": "file"}):
        with pytest.raises(ValueError, match="parallel.address=tcp://HOST:PORT of a scheduler"):
            ep.parallel.Dask(**given)
    with pytest.raises(ValueError, match="wait_s must be positive"):
        ep.parallel.Dask("tcp://here:1", wait_s=0.0)


@pytest.mark.slow
def test_a_cluster_that_is_not_there_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "none.json"
    monkeypatch.setitem(dask.config.config["distributed"]["comm"]["timeouts"], "connect", "0.2s")
    for given, place in (({"scheduler_file": str(file)}, file), ({"address": NOWHERE}, NOWHERE)):
        with pytest.raises(ValueError, match=f"a dask scheduler must run at {place}, got"):
            list(ep.parallel.Dask(**given).run(abs, [1]))


@pytest.mark.slow
@pytest.mark.parametrize("way", ["address", "scheduler_file", "joblib"])
def test_a_cluster_gives_the_same_bits(
    way: str, cluster: Cluster, serial_bytes: dict[str, bytes]
) -> None:
    if way != "joblib":
        workers = ep.parallel.Dask(**{way: getattr(cluster, way)})
        found = ep.pointwise(noisy(), searching(), workers=workers, block_points=2)
    else:
        from distributed import Client

        with Client(cluster.address, set_as_default=False) as client:
            client.wait_for_workers(2)
            with joblib.parallel_config("dask", client=client):
                found = ep.pointwise(noisy(), searching(), block_points=2)
    assert bytes_of(found) == serial_bytes


def process_of(piece: int) -> tuple[int, int]:
    return piece, os.getpid()


@pytest.mark.slow
def test_workers_of_a_cluster_outlive_the_program_and_keep_no_pieces(
    cluster: Cluster, tmp_path: Path
) -> None:
    """Each piece is computed in a worker, and written by this process."""
    workers = CachedWorkers(ep.parallel.Dask(cluster.address), tmp_path)
    found = dict(workers.run(process_of, range(8)))
    assert {process for _, process in found.values()} <= {w.pid for w in cluster.workers}
    assert [KeptPieces(tmp_path, 0).read(k) for k in range(8)] == [found[k] for k in range(8)]
    assert not list(Path(cluster.scheduler_file).parent.rglob("output.pkl"))
    assert all(worker.poll() is None for worker in cluster.workers)


@pytest.mark.slow
def test_a_killed_worker_costs_no_piece(tmp_path: Path, serial_bytes: dict[str, bytes]) -> None:
    with cluster_in(tmp_path) as running:
        found = ep.pointwise(
            noisy(), searching(), workers=ep.parallel.Dask(running.address), block_points=1,
            progress=lambda n_points: running.workers[0].kill(),
        )  # fmt: skip
        assert running.workers[1].poll() is None
    assert bytes_of(found) == serial_bytes


def kills_itself_once(piece: int, marker: str) -> int:
    if piece == 3 and not os.path.exists(marker):
        open(marker, "w").close()
        os.kill(os.getpid(), 9)
    return piece * piece


@pytest.mark.slow
def test_a_piece_whose_worker_is_killed_is_done_by_another(tmp_path: Path) -> None:
    marker = tmp_path / "killed"
    with cluster_in(tmp_path) as running:
        function = partial(kills_itself_once, marker=str(marker))
        found = dict(ep.parallel.Dask(running.address).run(function, range(8)))
    assert found == {k: k * k for k in range(8)}
    assert marker.exists()


@pytest.mark.slow
def test_ray_gives_the_same_bits(serial_bytes: dict[str, bytes]) -> None:
    ray = pytest.importorskip("ray")
    try:
        found = ep.pointwise(noisy(), searching(), workers=ep.parallel.Ray(), block_points=2)
    finally:
        ray.shutdown()
    assert bytes_of(found) == serial_bytes
