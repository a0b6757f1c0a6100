"""Files as other programs write them: one inspection, one experiment by what it printed."""

import json
import re
import shlex
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest
from scipy.integrate import solve_ivp

from tests.programs import ended

DT = 1e-6
A, B = 5e4, 8e4  # growth of the first, loss of the second, in 1/s


def cycle(t: np.ndarray) -> np.ndarray:
    """A cycle of prey and predators around (1, 1), shape (2, samples)."""
    found = solve_ivp(
        lambda _, x: [A * x[0] * (1 - x[1]), B * x[1] * (x[0] - 1)],
        (t[0], t[-1]), [0.6, 1.0], t_eval=t, rtol=1e-10, atol=1e-12,
    )  # fmt: skip
    return found.y


T = DT * np.arange(800)
X = cycle(T)
Z = np.linspace(0.0, 0.05, 6)
PROFILE = np.ones((2, len(Z)))


def scope_with_a_gap(folder: Path) -> str:
    """Tektronix: a preamble whose interval knows nothing of the time between two triggers."""
    t = DT * np.arange(1200)
    kept = np.r_[0:400, 800:1200]
    values = np.column_stack([t - 1e-4, *cycle(t)])[kept]
    rows = [f"{a:.6e},{b:.9g},{c:.9g}," for a, b, c in values]
    preamble = [
        "Model,MSO54", "Firmware Version,1.28.6", "", "Horizontal Units,S,",
        "Sample Interval,1e-06,", "Record Length,800,", "Vertical Units,V,V", ",,,", "Label,,,",
        "TIME,CH1,CH2",
    ]  # fmt: skip
    (folder / "scope.csv").write_text("\n".join([*preamble, *rows]) + "\n")
    return "scope.csv"


def group_per_step(folder: Path) -> str:
    with h5py.File(folder / "pic.h5", "w") as file:
        file["grid/z"] = Z
        for k in range(len(T)):
            group = file.create_group(f"data/{50 * k}")
            group["n_i"], group["n_n"] = (1e18 * x[k] * p for x, p in zip(X, PROFILE, strict=True))
            group.attrs["time"] = T[k]
    return "pic.h5"


def file_per_step(folder: Path) -> str:
    for k in range(0, len(T), 4):
        values = {"n_i": 1e18 * X[0, k] * PROFILE[0], "n_n": 1e18 * X[1, k] * PROFILE[1]}
        np.savez(folder / f"dump_{k:05d}.npz", **values, z=Z)
    return "dump_*.npz"


def excel(folder: Path) -> str:
    table = pd.DataFrame({"Time (us)": 1e6 * T, "prey (V)": X[0], "predator (V)": X[1]})
    table.to_excel(folder / "lab.xlsx", index=False)
    return "lab.xlsx"


def parquet(folder: Path) -> str:
    table = pd.DataFrame({"prey": X[0], "predator": X[1]}, index=pd.Index(T, name="t"))
    table.to_parquet(folder / "lab.parquet")
    return "lab.parquet"


FILES = [scope_with_a_gap, group_per_step, file_per_step, excel, parquet]


@pytest.mark.slow
@pytest.mark.parametrize("write", FILES)
def test_two_commands_lead_from_any_file_to_its_equations(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
    write: Callable[[Path], str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert not ended("inspect", write(tmp_path), "--write")
    (command,) = re.findall(r"ep2sindy (\+exp=discover .*)", capsys.readouterr().out)
    command = command.replace("STEP", f"{DT}")
    assert not ended(*shlex.split(command), "search=best_subset", "selection=ebic")
    (run,) = (tmp_path / "outputs" / "discover").iterdir()
    equations = json.loads((run / "summary.json").read_text())["models"]["model"]["equations"]
    (x, first), (y, second) = equations.items()
    scale = 1e-18 if x == "n_i" else 1.0
    product = next(name for name in first["terms"] if "*" in name)
    assert first["terms"] == pytest.approx({x: A, product: -A * scale}, rel=0.02)
    assert second["terms"] == pytest.approx({y: -B, product: B * scale}, rel=0.02)
