"""The pointwise study on a grid of 41 x 49 points and 12001 samples, read from disk, on one core.

Five terms, two equations, best supports of every size, 32 bootstraps of the rows. Next to it
PySINDy's `EnsembleOptimizer` (32 models) at ten thresholds, on the ready rows of one point.

    python -m benchmarks.pointwise [--folder where 1 GB fits]
"""

import argparse
import tempfile
import warnings
from pathlib import Path

import netCDF4
import numpy as np
import pysindy
import xarray as xr
from threadpoolctl import threadpool_limits

from benchmarks.regions import STATES, TERMS, UNITS
from benchmarks.timing import cpu_s
from ep2sindy.data.open import read_field
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.method import Regression
from ep2sindy.discovery.pointwise import PointSearch, pointwise
from ep2sindy.library.library import named_terms
from ep2sindy.regression.bootstraps import Bootstraps
from ep2sindy.regression.formulations import Differential
from ep2sindy.regression.rows import RegressionRows
from ep2sindy.regression.searches import BestSubset
from ep2sindy.runtime.parallel import ONE_BY_ONE, Workers
from ep2sindy.selection.criteria import Knee

N_Z, N_R, N_SAMPLES, DT_S = 41, 49, 12001, 1.5e-6
LEVELS = {"n_i": 4e17, "n_n": 3e18, "u_iz": 4e3, "u_ir": 5e2, "R_ion": 5e-14}
BLOCK_POINTS = 256
SEARCH = PointSearch(
    states=STATES,
    library=named_terms(list(UNITS), TERMS),
    method=Regression(
        formulation=Differential(),
        search=BestSubset(max_terms=5),
        selection=Knee(),
        bootstraps=Bootstraps(n=32, n_culled=0),
    ),
)


def write_grid(
    path: Path, rng: np.random.Generator, n_z: int = N_Z, n_r: int = N_R, n_samples: int = N_SAMPLES
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


def compare(path: Path) -> None:
    n_points = N_Z * N_R
    ours_s = cpu_s(lambda: study(read_field(path)), n_runs=1) / n_points
    print(f"{n_points} points x {N_SAMPLES} samples: {1e3 * ours_s:.2f} ms per point")
    problem = rows_at(read_field(path), 10, 20)
    theirs_s = cpu_s(lambda: ensemble_way(problem), n_runs=1)
    print(f"PySINDy's ensemble: {1e3 * theirs_s:.0f} ms, {theirs_s / ours_s:.0f} times")


def main() -> None:
    parser = argparse.ArgumentParser(description="the pointwise study at full size, on one core")
    parser.add_argument("--folder", type=Path, default=None, help="where 1 GB fits")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=given.folder) as made, threadpool_limits(limits=1):
        path = Path(made) / "grid.nc"
        write_grid(path, np.random.default_rng(0))
        compare(path)


if __name__ == "__main__":
    main()
