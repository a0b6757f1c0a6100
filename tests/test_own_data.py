"""A file of one's own on the command line: looked into, written down, run, and reported."""

import json
import shlex
import subprocess
import warnings
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
import yaml
from scipy.integrate import solve_ivp
from scipy.io import savemat

import ep2sindy as ep
from ep2sindy.app.inspection import NEEDS
from ep2sindy.app.runner import study_class
from ep2sindy.app.schema import study_of
from ep2sindy.data.quantities import DoubtfulUnit
from ep2sindy.library.units import SECONDS
from ep2sindy.thruster import ionization_rate
from tests.programs import EXPERIMENTS, ROOT, composed, computed, ended


def lorenz_csv(path: Path, *, seed: int = 0, lost: int = 0) -> None:
    """A file with semicolons, decimal commas and a preamble: a thousand samples."""
    start = np.random.default_rng(seed).uniform(-8.0, 8.0, 3) + np.array([0.0, 0.0, 25.0])
    run = ep.lorenz().trajectory(initial=start, noise=0.001, rng=seed).window(0, 1000)
    lines = ["made by;a scope", "", "Time;x;y;z", "(s);;;"]
    for k, row in enumerate(zip(run.t, *run.states.T, strict=True)):
        cells = [f"{value:.9g}".replace(".", ",") for value in row]
        if 100 <= k < 100 + lost:
            cells[1] = ""
        lines.append(";".join(cells))
    path.write_text("\n".join(lines) + "\n")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.slow
def test_two_commands_lead_from_a_file_to_its_equations(
    folder: Path, capsys: pytest.CaptureFixture
) -> None:
    lorenz_csv(folder / "scope.csv", lost=5)
    assert not ended("inspect", "scope.csv", "--write")
    printed = capsys.readouterr().out
    command = "ep2sindy +exp=discover data=scope 'trajectory.states=[x,y,z]'"
    assert command in printed
    rest = ["trajectory.states=[x,y,z]", "search=best_subset", "selection=ebic", "forecasts=0"]
    assert not ended("+exp=discover", "data=scope", *rest)
    (run,) = (folder / "outputs" / "discover").iterdir()
    summary = json.loads((run / "summary.json").read_text())
    terms = summary["models"]["model"]["equations"]["x"]
    assert terms == pytest.approx({"x": -10.0, "y": 10.0}, rel=0.05)
    assert "5 of 1000 samples are missing (NaN)" in summary["warnings"][0]


def test_a_written_config_is_that_of_the_file(folder: Path, capsys: pytest.CaptureFixture) -> None:
    np.savez(
        folder / "a b.npz",
        t_us=np.arange(9.0),
        z=np.linspace(0, 0.05, 4),
        ni_cm3=1e12 * np.ones((4, 9)) * np.linspace(1, 2, 9),
        null=np.arange(9.0),
    )
    assert not ended("inspect", "a b.npz", "--write", "mine")
    text = (folder / "conf" / "data" / "mine.yaml").read_text()
    config = yaml.safe_load(text)
    assert config["path"] == "a b.npz"
    assert config["variables"]["n_i"] == {"name": "ni_cm3", "unit": "cm^-3"}
    assert config["variables"]["null"] == {"name": "null", "unit": "1"}
    assert "# The file names no unit for z: put these right." in text
    field = ep.open_field(
        config.pop("path"), **{k: v for k, v in config.items() if k != "_target_"}
    )
    np.testing.assert_allclose(field["n_i"].values[-1], 2e18)
    for name, message in (("mine", "mine.yaml is there already"), ("file", "has data=file itself")):
        assert message in ended("inspect", "a b.npz", "--write", name)


def test_several_files_are_several_records(folder: Path) -> None:
    for k in range(2):
        lorenz_csv(folder / f"run{k}.csv", seed=k)
    overrides = [
        "+exp=discover", "data=recognised", "trajectory.states=[x,y,z]", f"output={folder}",
        "search=best_subset", "selection=ebic", "forecasts=0",
    ]  # fmt: skip
    found = computed(composed(*overrides, "data.path=run*.csv"))
    assert all(f"data: run{k}.csv; 1000 samples" in found.log for k in range(2))
    assert list(found.summary["evaluations"]) == ["model", "model, run1.csv"]
    assert found.summary["models"]["model"]["equations"]["x"] == pytest.approx(
        {"x": -10.0, "y": 10.0}, rel=0.01
    )


def test_a_gap_leaves_the_step_as_it_is(folder: Path, capsys: pytest.CaptureFixture) -> None:
    lorenz_csv(folder / "whole.csv")
    lines = (folder / "whole.csv").read_text().splitlines()
    (folder / "a.csv").write_text("\n".join(lines[:204] + lines[704:]))
    step = ep.inspect_file("whole.csv").held[0].step
    found = computed(composed(
        "+exp=discover", "data=recognised", "data.path=a.csv", "trajectory.states=[x,y,z]",
        "search=best_subset", "selection=ebic", "forecasts=0", f"output={folder}",
    ))  # fmt: skip
    assert list(found.summary["evaluations"]) == ["model"]
    assert f"500 samples of {SECONDS.duration_text(step, digits=4)} from" in found.log


@pytest.mark.parametrize(
    ("header", "times", "dt_s", "given_s"),
    [
        ("t (ms)", 20.0 * np.arange(50), 1.0, "0.02"),
        ("t", 20.0 * np.arange(50), 0.02, ""),  # ms, which dt_s says
        ("t", 20.0 * np.arange(50), 0.5, "20"),
        ("t (s)", 0.01 * np.r_[0:25, 100:125], 0.01, ""),  # with a gap
    ],
)
def test_a_step_that_contradicts_the_files_times_is_reported(
    folder: Path, header: str, times: np.ndarray, dt_s: float, given_s: str
) -> None:
    rows = "\n".join(f"{t:.9g},{k % 7}" for k, t in enumerate(times))
    (folder / "a.csv").write_text(f"{header},V\n{rows}\n")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        field = ep.open_field("a.csv", dt_s=dt_s)
    assert field.time[1] == dt_s  # taken in any case
    texts = [str(each.message) for each in caught if each.category is DoubtfulUnit]
    assert len(texts) == bool(given_s)
    for text in texts:
        assert f"'t', which go in steps of {given_s} s" in text


WAVE = np.outer(np.arange(1.0, 6.0), np.arange(1.0, 11.0))
GRID = xr.Dataset(
    {"n_i": (("time", "z"), WAVE, {"units": "m^-3"})},
    coords={"time": np.arange(5.0), "z": np.linspace(0.0025, 0.0475, 10)},
)


def test_downstream_is_the_last_part_of_a_channel_that_is_known() -> None:
    zone = ep.Zone(z="downstream")
    known = GRID.assign_attrs(channel_m=0.025)
    average = ep.data.ZoneAverage(["n_i"], zone)
    run = average.trajectory(known, inputs=[], label="")
    by_hand = ep.zone_average(GRID, ep.Zone(z=(0.015, 0.025)), states=["n_i"])
    np.testing.assert_array_equal(run.states, by_hand.states)
    whole = ep.zone_average(known, ep.Zone(z="channel"), states=["n_i"])
    by_hand = ep.zone_average(GRID, ep.Zone(z=(0.0, 0.025)), states=["n_i"])
    np.testing.assert_array_equal(whole.states, by_hand.states)
    simulated = GRID.assign_attrs(parameters=json.dumps({"thruster": {"channel_length": 0.025}}))
    assert average.place(simulated) == average.place(known)


def test_a_channel_that_is_not_known_is_asked_for() -> None:
    with pytest.raises(ValueError, match=r"give data.channel_m=LENGTH in m, or a zone of your own"):
        ep.zone_average(GRID, ep.Zone(z="downstream"), states=["n_i"])
    flat = GRID.isel(z=0, drop=True)
    assert ep.zone_average(flat, ep.Zone(z="downstream"), states=["n_i"]).n_samples == 5
    with pytest.raises(ValueError, match="in m or one of channel, downstream, got 'upstream'"):
        ep.Zone(z="upstream")


def test_every_experiment_on_files_is_known_to_an_inspection() -> None:
    """Those that take the data group; what they need is in their configs."""
    made = {"simulate", "benchmark", "frontier", "weak_windows"}
    assert set(NEEDS) == {*EXPERIMENTS} - made
    for name in ("breathing", "parametric", "pointwise"):
        text = str(composed(f"+exp={name}"))
        assert all(variable in text for variable in NEEDS[name])


# Point by file: L (m), g_inj (m^-3 s^-1) and eps of the thesis's Eq. 25, from its Table V.
EQ_25 = {
    "V200_m5": (0.016, 2.72e23, 1.01), "V300_m2": (0.021, 7.31e22, 0.91),
    "V300_m4": (0.024, 1.53e23, 0.81), "V300_m5": (0.025, 1.85e23, 0.78),
    "V300_m6": (0.027, 2.17e23, 0.75), "V400_m5": (0.028, 1.57e23, 0.76),
}  # fmt: skip
NAMES = [
    *(f"data.variables.{ours}.name=data.{ours[:3]}" for ours in ("n_i", "n_n", "T_e_eV")),
    "data.variables.u_iz.name=data.uz", "data.variables.u_ir.name=data.ur",
    'data.z.name="data.zs[:, 0]"', 'data.r.name="data.rs[0, :]"',
]  # fmt: skip


def write_uniform(path: Path, length: float, inflow: float, eps: float) -> None:
    """A solution of Eq. 25 on a grid of 6 x 5 points: R_ion of T_e and u_iz oscillate at 10 kHz."""
    fine = np.linspace(0.0, 1.2e-3, 8001)
    warm = 20.0 + 2.0 * np.sin(2e4 * np.pi * fine)
    rate = ionization_rate(xr.Dataset({"T_e_eV": ("time", warm)}))["R_ion"].values
    speed = 9e3 + 5e2 * np.cos(2e4 * np.pi * fine)

    def slope(t: float, n: np.ndarray) -> list[float]:
        born = eps * n[0] * n[1] * np.interp(t, fine, rate)
        return [born - n[0] * np.interp(t, fine, speed) / length, inflow - born]

    rest = np.array([inflow * length / 9e3, 9e3 / (length * eps * rate.mean())])
    times = fine[::10]
    ions, neutrals = solve_ivp(slope, (0.0, times[-1]), rest, t_eval=times, rtol=1e-6).y
    zs, rs = np.meshgrid(np.linspace(0.001, 0.024, 6), np.linspace(0.036, 0.049, 5), indexing="ij")
    columns = {"n_i": ions, "n_n": neutrals, "T_e": warm[::10], "uz": speed[::10]}
    data = {name: values[:, None, None] + 0 * zs for name, values in columns.items()}
    savemat(path, {"data": data | {"ur": 0 * data["uz"], "zs": zs, "rs": rs}})


def rerun(folder: Path) -> dict[str, list[str]]:
    """By experiment the settings that `make thesis` gives it."""
    make = ["make", "-n", "-o", ".venv/installed", "thesis", f"FOLDER={folder}"]
    printed = subprocess.run(make, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    found = {}
    for line in printed.replace("\\\n", "").splitlines():
        words = [word for word in shlex.split(line)[3:] if word != "-m"]
        for name in words[0].removeprefix("+exp=").split(","):
            found[name] = [f"+exp={name}", *words[1:], f"output={folder}"]
    return found


@pytest.mark.parametrize(
    ("name", "toy"),
    [
        pytest.param("breathing", ["sustained=none", "forecasts=0"], marks=pytest.mark.slow),
        pytest.param("weak", [], marks=pytest.mark.slow),
        pytest.param("ils", ["n_draws=1", "windows=[12]"], marks=pytest.mark.slow),
        ("constrained", []),
        pytest.param("pointwise", ["parallel=serial", "keep=false"], marks=pytest.mark.slow),
        ("parametric", ["parallel=serial", "keep=false", "windows.n_windows=20"]),
    ],
)
def test_the_thesis_is_rerun_on_a_folder_of_its_files(
    folder: Path, name: str, toy: list[str]
) -> None:
    for point in EQ_25 if name == "parametric" else ["V300_m5"]:
        write_uniform(folder / f"{point}.mat", *EQ_25[point])
    found = computed(composed(*rerun(folder)[name], *NAMES, *toy))
    assert found.summary["experiment"] == name
    if name == "parametric":
        shown = [q for q in found.summary["quantities"] if q["fit"] == "constrained"]
        assert len(shown) == 3 * len(EQ_25)
        assert [q["value"] for q in shown] == pytest.approx([q["thesis"] for q in shown], rel=0.02)
    elif name == "constrained":
        terms = found.summary["models"]["velocity_constrained"]["equations"]["n_i"]
        exact = {"n_i*u_iz": -1 / 0.025, "n_i*n_n*R_ion": 0.78}
        assert terms == pytest.approx(exact, rel=0.02)


def test_the_names_that_the_thesis_does_not_state_are_asked_for_at_once() -> None:
    config = composed("+exp=constrained", "data=hyphen", "data.path=a.mat")
    with pytest.raises(ValueError, match=r"s.n_i.name, .*z.name and data.r.name must be set, got"):
        study_of(study_class(config.study), config)
