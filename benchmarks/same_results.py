"""Do two checkouts find the same? Every experiment at toy size in both, compared to the last digit.

    python -m benchmarks.same_results OTHER_CHECKOUT

What no experiment computes is a small program instead, run in both checkouts: the (z, r)
simulator, a law over operating points and a neural correction. Compares summaries, models and
tables, but for times. What only this checkout writes is named and allowed; anything that differs,
or that it lacks, ends the program with status 1.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from scipy.integrate import solve_ivp

HERE = Path(__file__).resolve().parents[1]
TIMES = {"cpu_s", "cpu_ms", "wall_s", "points_per_s", "cpu_s_per_search"}
ON_FILE = ["data=file", "data.variables.R_ion.name=R_ion", "data.variables.u_iz.name=u_iz"]
LINE, GRID = "data.path={line}", "data.path={grid}"
ZONE = "trajectory.zone.z=[0.015,0.025]"
TOYS: dict[str, list[str]] = {
    "breathing": [
        "+exp=breathing", *ON_FILE, LINE, ZONE, "bootstraps.n=8", "search=adaptive_lasso",
    ],
    "discover": [
        "+exp=discover", *ON_FILE, LINE, "trajectory.states=[n_i,n_n]", "formulation=weighted_weak",
        "search=best_subset", "selection=ebic",
    ],
    "benchmark": [
        "+exp=benchmark", "variants=[STLSQ,BALASSO,wALASSO,ours]", "n_realizations=2",
        "systems=[oscillator,lotka_volterra]", "noises=[0.0,0.05]", "parallel=serial",
    ],
    "weak": [
        "+exp=weak", *ON_FILE, LINE, ZONE, "~fits.n_points_70", "~fits.n_points_300",
        "forms.n_points_10.test_functions.n_windows=500",
        "forms.n_points_50.test_functions.n_windows=500",
    ],
    "weak_windows": [
        "+exp=weak_windows",
        "grids.boxes.test_functions={{n_windows: [100,300], n_points: [10,30]}}",
        "noises=[0.0,0.1]", "n_realizations=2", "parallel=serial",
    ],
    "frontier": [
        "+exp=frontier", "variants=[STLSQ,ours]", "rates_Hz=[1,20]", "durations_s=[5,40]",
        "parallel=serial",
    ],
    "constrained": ["+exp=constrained", *ON_FILE, LINE, ZONE],
    "ils": [
        "+exp=ils", *ON_FILE, LINE, ZONE, "n_windows=8", "windows=[30,60]",
        "forms.weak.test_functions.n_windows=500", "forms.weak.test_functions.n_points=50",
    ],
    "parametric": [
        "+exp=parametric", "data.cache={cache}", "data.duration_s=2.0e-3", "data.warm_up_s=0.5e-3",
        "data.n_cells=30", "parallel=serial", "windows.n_windows=20",
        "points=[{{V_D_V: 200.0, mdot_mg_s: 5.0, "
        "data: {{operating_point: {{neutral_speed: 320.0}}}}}}, {{V_D_V: 300.0, mdot_mg_s: 5.0}},"
        "{{V_D_V: 300.0, mdot_mg_s: 2.0, data: {{operating_point: {{neutral_speed: 195.0}}}}}}]",
    ],
    "predict": [
        "+exp=predict", "data.cache={cache}", "data.duration_s=2.0e-3", "data.warm_up_s=1.0e-3",
        "data.n_cells=30", "parallel=serial", "law=1",
        "windows={{n_windows: 4, periods: 1.0}}", "map_points=3",
        "points=[{{V_D_V: [280.0, 300.0, 320.0], mdot_mg_s: [5.0, 5.5]}}]",
    ],
    "pointwise": [
        "+exp=pointwise", *ON_FILE, GRID, "data.r.name=r", "data.variables.u_ir.name=u_ir",
        "parallel=serial", "bootstraps.n=6", "block_points=5", "max_regimes=3",
    ],
    "trace": [
        "+exp=trace", "data=file", "data.path={signal}", "signal=I", "unit=A", "search.n_best=2",
        "search.max_terms=4", "depth=2", "selection.n_starts=2", "selection.n_windows=6",
    ],
    "simulate": [
        "+exp=simulate", "data.cache={cache}", "data.duration_s=6.0e-4", "data.warm_up_s=1.0e-4",
        "data.n_cells=24", "data.progress=false",
    ],
}  # fmt: skip
# Programs that write tables into the folder they are given.
PROGRAMS: dict[str, str] = {
    "simulate_2d": """
import json, sys
from pathlib import Path
import ep2sindy as ep
field = ep.thruster.simulate_2d(duration_s=3e-5, warm_up_s=5e-6, n_z=24, n_r=10, progress=False)
values = {str(name): field[name].values.ravel().tolist() for name in field.data_vars}
Path(sys.argv[1], "field.json").write_text(json.dumps(values | {"status": field.attrs["status"]}))
""",
    "law": """
import sys
from dataclasses import replace
from pathlib import Path
import ep2sindy as ep
growth = (0.5, 0.7, 0.9, 1.1)
runs = [ep.lotka_volterra(a=a).trajectory(noise=0.02, rng=0) for a in growth]
runs = [replace(run, parameters={"a": a}) for run, a in zip(runs, growth)]
ep.discover(runs, law="auto").law.save(Path(sys.argv[1], "law.json"))
""",
    "correction": """
import json, sys
from pathlib import Path
import torch
import ep2sindy as ep
prey = ep.lotka_volterra()
library = ep.named_terms(["x", "y"], ["x", "y"])
rates = [{name: prey.model.terms(name)[name]} for name in ("x", "y")]
known = ep.SparseModel(library, ["x", "y"], ep.model.coef_matrix(library, rates))
torch.manual_seed(0)
last = torch.nn.Linear(4, 2)
torch.nn.init.zeros_(last.weight)
torch.nn.init.zeros_(last.bias)
network = torch.nn.Sequential(torch.nn.Linear(2, 4), torch.nn.Tanh(), last)
run = prey.trajectory(noise=0.01, rng=0)
fit = ep.refinement.refine_with_correction(
    known, [run], network, window=15, n_windows=4, seed=0,
    method=ep.refinement.GradientDescent(max_iter=4),
)
states = run.states[::50]
values = {
    "coef": fit.model.coef.tolist(),
    "losses": [fit.loss_before, fit.loss, *fit.window_loss.tolist()],
    "status": fit.status,
    "history": [step.loss for step in fit.history],
    "learned": fit.learned(states).tolist(),
}
Path(sys.argv[1], "correction.json").write_text(json.dumps(values))
""",
}


def main() -> None:
    names = [*TOYS, *PROGRAMS]
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("other", type=Path, help="the checkout to compare with")
    parser.add_argument("--only", nargs="*", choices=names, default=names)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        paths = write_data(Path(folder))
        wrong = [name for name in arguments.only if not is_same(name, arguments.other, paths)]
    sys.exit(f"they differ in {wrong}" if wrong else 0)


def write_data(folder: Path) -> dict[str, Path]:
    """A line by the thesis's Eq. 23, a grid whose regions follow laws apart, and one signal."""
    t = 1.5e-6 * np.arange(1200)
    profile = np.linspace(0.9, 1.1, 5)
    line = _field(_predator_prey(t)[:, :, None] * profile, t, {"z": np.linspace(0.012, 0.028, 5)})
    waves = _predator_prey(t[:300])[:, :, None, None] * np.linspace(0.8, 1.2, 6)[:, None]
    axes = {"z": np.linspace(0.0, 0.03, 6), "r": np.linspace(0.036, 0.049, 5)}
    grid = _field(waves * np.linspace(0.95, 1.05, 5), t[:300], axes)
    line.to_netcdf(folder / "line.nc")
    grid.to_netcdf(folder / "grid.nc")
    signal = pd.DataFrame({"time": t, "I": _predator_prey(t)[:, 0] / 1e17})
    signal.to_csv(folder / "signal.csv", index=False)
    paths = {name: folder / f"{name}.nc" for name in ("line", "grid")}
    return paths | {"signal": folder / "signal.csv", "folder": folder}


def _predator_prey(t: np.ndarray) -> np.ndarray:
    """(samples, 2): densities of ions and neutrals."""

    def slope(_: float, x: np.ndarray) -> np.ndarray:
        born = 4.66e-14 * x[0] * x[1]
        return np.array([born - 1.64e5 * x[0], 4.39e4 * x[1] - born])

    span = (t[0], t[-1])
    return solve_ivp(slope, span, [5e17, 4e18], "DOP853", t, rtol=1e-9, atol=1e6).y.T


def _field(densities: np.ndarray, t: np.ndarray, axes: dict[str, np.ndarray]) -> xr.Dataset:
    shape = (len(t), *(len(axis) for axis in axes.values()))
    wave = (slice(None), *[None] * len(axes))
    values = {
        "n_i": (densities[:, 0], "m^-3"),
        "n_n": (densities[:, 1], "m^-3"),
        "R_ion": (np.broadcast_to(4e-14 * (1 + 0.3 * np.sin(9e4 * t))[wave], shape), "m^3/s"),
        "u_iz": (np.broadcast_to(5e3 * (1 + 0.2 * np.sin(7e4 * t))[wave], shape), "m/s"),
        "u_ir": (np.broadcast_to(5e2 * (1 + 0.2 * np.sin(5e4 * t))[wave], shape), "m/s"),
    }
    units = {name: {"units": "m"} for name in axes} | {"time": {"units": "s"}}
    field = xr.Dataset(
        {name: (("time", *axes), v, {"units": unit}) for name, (v, unit) in values.items()},
        coords={"time": t, **axes},
    )
    for name, attributes in units.items():
        field[name].attrs = attributes
    return field


def is_same(name: str, other: Path, paths: dict[str, Path]) -> bool:
    found = []
    for number, checkout in enumerate((other.resolve(), HERE)):
        output = paths["folder"] / f"{name}_{number}"
        places = {**paths, "cache": paths["folder"] / f"cache_{number}"}
        run = outcome(name, checkout, output, places)
        if run.returncode:
            print(f"{name}: failed in {checkout}:\n{run.stderr[-2000:]}")
            return False
        found.append(contents(output if name in PROGRAMS else folder_of(run.stdout)))
    before, now = found
    if not before:
        print(f"{name}: no files in {other} to compare with")
        return False
    differences = [text for path in before for text in differing(before[path], now.get(path), path)]
    new = sorted(set(now) - set(before))
    print(
        f"{name}: {len(before)} files, "
        + (f"{len(differences)} differences" if differences else "the same")
        + (f"; new here: {new}" if new else "")
    )
    for text in differences[:10]:
        print(f"  {text}")
    return not differences


def folder_of(printed: str) -> Path:
    """The run folder that the last line of an experiment names, by its page or by itself."""
    path = Path(printed.splitlines()[-1].removeprefix("open: "))
    return path.parent if path.suffix == ".html" else path


def outcome(
    name: str, checkout: Path, output: Path, places: dict[str, Path]
) -> subprocess.CompletedProcess[str]:
    """A toy or a program, run by the code of a checkout."""
    if name in PROGRAMS:
        output.mkdir()
        command = ["-c", PROGRAMS[name], str(output)]
    else:
        overrides = [text.format(**places) for text in TOYS[name]]
        command = ["-m", "experiments.run", *overrides, f"output={output}"]
    return subprocess.run(
        [sys.executable, *command], cwd=checkout, env={**os.environ, "PYTHONPATH": str(checkout)},
        capture_output=True, text=True, check=False,
    )  # fmt: skip


def contents(folder: Path) -> dict[str, Any]:
    """Summary, models and tables of a run, by path."""
    found: dict[str, Any] = {}
    for path in sorted(folder.rglob("*.json")):
        if path.name != "provenance.json":
            found[str(path.relative_to(folder))] = json.loads(path.read_text())
    for path in sorted(folder.rglob("*.csv")):
        table = pd.read_csv(path, dtype=str, keep_default_na=False)
        found[str(path.relative_to(folder))] = table.to_dict("list")
    return found


def differing(before: Any, now: Any, place: str) -> Iterator[str]:
    """Where what was there is another, or missing; what is new does not count."""
    if isinstance(before, dict) and isinstance(now, dict):
        for key, value in before.items():
            if key.split("/")[-1] not in TIMES:
                yield from differing(value, now.get(key), f"{place}: {key}")
    elif isinstance(before, list) and isinstance(now, list) and len(before) == len(now):
        for k, (one, other) in enumerate(zip(before, now, strict=True)):
            yield from differing(one, other, f"{place}[{k}]")
    elif before != now and not (_is_nan(before) and _is_nan(now)):
        yield f"{place}: {str(before)[:80]} became {str(now)[:80]}"


def _is_nan(value: Any) -> bool:
    return isinstance(value, float) and math.isnan(value)


if __name__ == "__main__":
    main()
