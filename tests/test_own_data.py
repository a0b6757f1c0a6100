"""A file of one's own on the command line: looked into, written down, run, and reported."""

import json
import warnings
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
import yaml

import ep2sindy as ep
from ep2sindy.app.inspection import NEEDS
from ep2sindy.data.quantities import DoubtfulUnit
from ep2sindy.library.units import SECONDS
from tests.programs import EXPERIMENTS, composed, computed, ended


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
