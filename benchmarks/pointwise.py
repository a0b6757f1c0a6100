"""The pointwise study on a grid of 41 x 49 points and 12001 samples, read from disk, on one core.

Five terms, two equations, best supports of every size, 32 bootstraps of the rows. Next to it, per
point: the plain way (scikit-learn's `lasso_path` with 100 penalties on the resampled rows of every
bootstrap, `lstsq` for every support found), and PySINDy's `EnsembleOptimizer` (32 models) at ten
thresholds; both are given rows that are ready, and only a few points of the same grid.

    python -m benchmarks.pointwise [--folder where 1 GB fits]
"""

import argparse
import resource
import tempfile
import time
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path

import netCDF4
import numpy as np
import pysindy
import xarray as xr
from sklearn.exceptions import ConvergenceWarning
from sklearn.linear_model import lasso_path
from threadpoolctl import threadpool_limits

from benchmarks.timing import cpu_s
from ep2sindy.data.open import read_field
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.method import Regression
from ep2sindy.discovery.pointwise import PointSearch, blocks_of, pointwise
from ep2sindy.library.library import named_terms
from ep2sindy.regression.bootstraps import Bootstraps
from ep2sindy.regression.formulations import Differential
from ep2sindy.regression.rows import RegressionRows
from ep2sindy.regression.searches import BestSubset
from ep2sindy.runtime.parallel import ONE_BY_ONE, Workers
from ep2sindy.selection.criteria import Knee

N_Z, N_R, N_SAMPLES, DT_S = 41, 49, 12001, 1.5e-6
UNITS = {"n_i": "m^-3", "n_n": "m^-3", "u_iz": "m/s", "u_ir": "m/s", "R_ion": "m^3/s"}
LEVELS = {"n_i": 4e17, "n_n": 3e18, "u_iz": 4e3, "u_ir": 5e2, "R_ion": 5e-14}
TERMS = ["1", "n_n", "n_i*u_iz", "n_i*u_ir", "n_i*n_n*R_ion"]
BLOCK_POINTS = 256
SEARCH = PointSearch(
    states=["n_i", "n_n"],
    library=named_terms(list(UNITS), TERMS),
    method=Regression(
        formulation=Differential(),
        search=BestSubset(max_terms=5),
        selection=Knee(),
        bootstraps=Bootstraps(n=32, n_culled=0),
    ),
)


def write_grid(
    path: Path,
    rng: np.random.Generator,
    n_z: int = N_Z,
    n_r: int = N_R,
    n_samples: int = N_SAMPLES,
) -> None:
    """Oscillations of 14 kHz and its harmonic with 2 % noise, different at every point."""
    t = np.arange(n_samples) * DT_S
    axes = {"time": t, "z": np.linspace(0.0, 0.05, n_z), "r": np.linspace(0.028, 0.057, n_r)}
    with netCDF4.Dataset(path, "w") as file:
        for axis, points in axes.items():
            file.createDimension(axis, len(points))
            variable = file.createVariable(axis, "f8", (axis,))
            variable[:] = points
            variable.units = "s" if axis == "time" else "m"
        for name, unit in UNITS.items():
            variable = file.createVariable(name, "f8", tuple(axes), contiguous=True)
            variable.units = unit
            phase, strength = rng.uniform(0.0, 2 * np.pi, (2, n_z, n_r)), rng.uniform(0.2, 0.6, 2)
            for start in range(0, n_samples, 1000):
                turn = 2 * np.pi * 14e3 * t[start : start + 1000, None, None]
                wave = sum(
                    a * np.sin(k * turn + p)
                    for k, (a, p) in enumerate(zip(strength, phase, strict=True), start=1)
                )
                noise = 0.02 * rng.standard_normal(wave.shape)
                variable[start : start + 1000] = LEVELS[name] * (1.0 + wave + noise)


def study(field: xr.Dataset, workers: Workers = ONE_BY_ONE) -> xr.Dataset:
    return pointwise(field, SEARCH, workers=workers, block_points=BLOCK_POINTS)


def read_all(field: xr.Dataset) -> None:
    """What reading costs without any search."""
    for block in blocks_of(field, BLOCK_POINTS):
        field.isel(block).load()


def rows_at(field: xr.Dataset, iz: int, ir: int) -> RegressionRows:
    point = field.isel(z=iz, r=ir).load()
    states = np.stack([point[name].values for name in SEARCH.states], axis=1)
    names = SEARCH.variables[len(SEARCH.states) :]
    inputs = np.stack([point[name].values for name in names], axis=1)
    run = Trajectory(point["time"].values, states, SEARCH.states, inputs, names)
    (problem,) = SEARCH.method.formulation.assemble(
        [run], SEARCH.library, rng=np.random.default_rng(0)
    )
    return problem


def plain_way(problem: RegressionRows, *, once: bool = False) -> None:
    """Lasso paths of resampled rows, and a fit of every support as it comes up along them.

    once: fit none twice, which takes a thought.
    """
    rng = np.random.default_rng(0)
    theta = problem.train_theta
    for target in map(problem.scaled_target, range(len(problem.equations))):
        supports = []
        for _ in range(SEARCH.method.bootstraps.n):
            size = int(rng.uniform(0.2, 0.8) * len(theta))
            rows = rng.integers(len(theta), size=size)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", ConvergenceWarning)
                _, paths, _ = lasso_path(theta[rows], target[rows], alphas=100)
            supports += [tuple(np.flatnonzero(column)) for column in paths.T]
        for support in set(supports) if once else supports:
            np.linalg.lstsq(theta[:, list(support)], target)


def ensemble_way(problem: RegressionRows) -> None:
    """PySINDy's bagging at ten thresholds, on columns that are scaled."""
    n_terms = len(problem.library)
    theta, targets = problem.train_columns.T[:, :n_terms], problem.train_columns.T[:, n_terms:]
    for threshold in np.geomspace(1e-3, 1.0, 10):
        optimizer = pysindy.EnsembleOptimizer(
            pysindy.STLSQ(threshold=threshold, alpha=0.0),
            bagging=True,
            n_models=SEARCH.method.bootstraps.n,
            n_subset=len(theta) // 2,
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # the highest removes every term
            optimizer.fit(theta, targets)


def per_point(way: Callable[[RegressionRows], None], problems: list[RegressionRows]) -> float:
    begin = time.process_time()
    for problem in problems:
        way(problem)
    return (time.process_time() - begin) / len(problems)


def compare(path: Path) -> None:
    field = read_field(path)
    n_points = N_Z * N_R
    read_s = cpu_s(lambda: read_all(field), n_runs=1)
    total_s = cpu_s(lambda: study(field), n_runs=1)
    # Kilobytes on Linux, bytes on macOS.
    peak_GiB = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    ours = total_s / n_points
    print(f"{n_points} points x {N_SAMPLES} samples, {path.stat().st_size / 1e9:.2f} GB on disk")
    print(f"  reading                   {read_s:8.1f} CPU-s")
    print(f"  reading and searching     {total_s:8.1f} CPU-s, {1e3 * ours:.2f} ms per point")
    print(f"  peak memory               {peak_GiB:8.2f} GiB")
    problems = [rows_at(field, iz, 20) for iz in (10, 30)]
    ways: dict[str, Callable[[RegressionRows], None]] = {
        "scikit-learn": plain_way,
        "the same, no fit twice": partial(plain_way, once=True),
        "PySINDy ensemble": ensemble_way,
    }
    for name, way in ways.items():
        each = per_point(way, problems)
        print(f"  {name:<25} {1e3 * each:8.0f} ms per point, {each / ours:.0f} times")


def main() -> None:
    parser = argparse.ArgumentParser(description="the pointwise study at full size, on one core")
    parser.add_argument("--folder", type=Path, default=None, help="where 1 GB fits")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=given.folder) as made, threadpool_limits(limits=1):
        path = Path(made) / "grid.nc"
        write_grid(path, np.random.default_rng(0), N_Z, N_R, N_SAMPLES)
        compare(path)


if __name__ == "__main__":
    main()
