"""The pointwise study on two workers of a dask cluster: what is sent, and what CPU time is lost.

For a grid of 41 x 49 and one of 100 x 100 points of 1201 samples in a file: bytes per point of a
block that travels to a worker, from the file and if the field is in memory, and of its result that
travels back; and the CPU time of the serial study as a fraction of that of all processes.

    python -m benchmarks.cluster [--folder where 0.5 GB fits]
"""

import argparse
import tempfile
import time
from pathlib import Path

import cloudpickle
import numpy as np
from distributed import Client, LocalCluster
from threadpoolctl import threadpool_limits

from benchmarks.pointwise import BLOCK_POINTS, study, write_grid
from ep2sindy.data.open import read_field
from ep2sindy.discovery.pointwise import blocks_of
from ep2sindy.runtime.parallel import Dask

GRIDS, N_SAMPLES, N_WORKERS = ((41, 49), (100, 100)), 1201, 2


def compare(path: Path, n_points: int, client: Client, workers: Dask) -> None:
    field = read_field(path)
    block = field.isel(blocks_of(field, BLOCK_POINTS)[0])
    result, n_block = study(block.load()), block.sizes["z"] * block.sizes["r"]
    sent = {
        "block of a file": field.isel(blocks_of(field, BLOCK_POINTS)[0]),
        "block in memory": block,
        "result": result,
    }
    print(f"{n_points} points x {N_SAMPLES} samples")
    for name, value in sent.items():
        print(f"  {name:<16} {len(cloudpickle.dumps(value)) / n_block:9.0f} bytes per point")
    before_s, begin = sum(client.run(time.process_time).values()), time.process_time()
    study(read_field(path), workers)
    middle, after_s = time.process_time(), sum(client.run(time.process_time).values())
    study(read_field(path))
    serial_s, whole_s = time.process_time() - middle, middle - begin + after_s - before_s
    share = 100.0 * serial_s / whole_s
    print(f"  serial {serial_s:.1f} CPU-s, on the cluster {whole_s:.1f}: {share:.0f} %")


def main() -> None:
    parser = argparse.ArgumentParser(description="the pointwise study on two workers of dask")
    parser.add_argument("--folder", type=Path, default=None, help="where 0.5 GB fits")
    given = parser.parse_args()
    quiet = {"threads_per_worker": 1, "dashboard_address": None, "silence_logs": 40}
    with (
        tempfile.TemporaryDirectory(dir=given.folder) as made,
        threadpool_limits(limits=1),
        LocalCluster(n_workers=N_WORKERS, **quiet) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        workers = Dask(cluster.scheduler_address)
        for n_z, n_r in ((10, 100), *GRIDS):  # on the first, workers load the package
            path = Path(made) / f"{n_z}_{n_r}.nc"
            write_grid(path, np.random.default_rng(0), n_z, n_r, N_SAMPLES)
            compare(path, n_z * n_r, client, workers)


if __name__ == "__main__":
    main()
