"""A file of one's own on the command line: looked into, written down, run, and stated."""

import json
import re
import shlex
import warnings
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
import yaml

import ep2sindy as ep
from ep2sindy.app.inspection import NEEDS
from ep2sindy.app.runner import run_config
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


def test_two_commands_lead_from_a_file_to_its_equations(
    folder: Path, capsys: pytest.CaptureFixture
) -> None:
    lorenz_csv(folder / "scope.csv", lost=5)
    assert not ended("inspect", "scope.csv", "--write")
    stated = capsys.readouterr().out
    assert "between semicolons, decimal commas, rows from line 5" in stated
    command = "ep2sindy +exp=discover data=scope 'trajectory.states=[x,y,z]'"
    assert command in stated
    rest = ["trajectory.states=[x,y,z]", "search=best_subset", "selection=ebic"]
    assert not ended("+exp=discover", "data=scope", *rest)
    (run,) = (folder / "outputs" / "discover").iterdir()
    summary = json.loads((run / "summary.json").read_text())
    terms = summary["models"]["model"]["equations"]["x"]
    assert terms == pytest.approx({"x": -10.0, "y": 10.0}, rel=0.05)
    page, log = (run / "report.html").read_text(), (run / "run.log").read_text()
    for part in ("data: scope.csv", "995 samples", "x in 1"):
        assert part in page
        assert part in log
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
    assert "data.channel_m=LENGTH" in capsys.readouterr().out
    for name, message in (("mine", "mine.yaml is there already"), ("file", "has data=file itself")):
        assert message in ended("inspect", "a b.npz", "--write", name)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["none.csv"], "error: no such file: .*none.csv"),
        (["*.h5"], "no file fits the pattern '\\*.h5'"),
    ],
)
def test_what_cannot_be_looked_into_ends_in_one_message(
    folder: Path, arguments: list[str], message: str
) -> None:
    np.savez(folder / "a.npz", t=np.arange(5.0), x=np.arange(5.0) ** 2)
    assert re.search(message, ended("inspect", *arguments))


def test_several_files_are_several_records(folder: Path) -> None:
    for k in range(2):
        lorenz_csv(folder / f"run{k}.csv", seed=k)
    overrides = [
        "+exp=discover", "data=recognised", "trajectory.states=[x,y,z]", f"output={folder}",
        "search=best_subset", "selection=ebic",
    ]  # fmt: skip
    found = computed(composed(*overrides, "data.path=run*.csv"))
    assert all(f"data: run{k}.csv; 1000 samples" in found.log for k in range(2))
    assert list(found.summary["evaluations"]) == ["model", "model, run1.csv"]
    assert found.summary["models"]["model"]["equations"]["x"] == pytest.approx(
        {"x": -10.0, "y": 10.0}, rel=0.01
    )


def proposed(capsys: pytest.CaptureFixture, *arguments: str) -> list[str]:
    """The commands that an inspection prints, without the program's name."""
    assert not ended("inspect", *arguments)
    return re.findall(r"^  ep2sindy (.*)", capsys.readouterr().out, re.MULTILINE)


def test_a_file_that_lacks_only_its_times_goes_on_with_a_step(
    folder: Path, capsys: pytest.CaptureFixture
) -> None:
    np.savez("a.npz", V=np.sin(np.arange(50.0)))
    (trace,) = proposed(capsys, "a.npz")
    assert trace == "+exp=trace data=recognised data.path=a.npz data.dt_s=STEP signal=V"
    settings = composed(*shlex.split(trace.replace("STEP", "1e-6"))).data
    assert ep.open_field(settings.path, dt_s=settings.dt_s).time[1] == 1e-6


def test_several_records_are_shown_once_and_go_to_what_takes_several(
    folder: Path, capsys: pytest.CaptureFixture
) -> None:
    for name, seed in {"a": 0, "b": 1, "c d": 2}.items():
        lorenz_csv(folder / f"{name}.csv", seed=seed)
    (folder / "b.csv").write_text("\n".join((folder / "b.csv").read_text().split("\n")[:900]))
    assert not ended("inspect", "a.csv", "b.csv", "c d.csv")
    stated = capsys.readouterr().out
    assert stated.count("taken as") == 1
    assert "\nthe other 2 files: the same arrays; 896 to 1000 samples\n" in stated
    (line,) = re.findall(r"ep2sindy (\+exp=.*)", stated)
    config = composed(*shlex.split(line))
    assert config.experiment == "discover"
    assert config.data.path == ["a.csv", "b.csv", "c d.csv"]


def test_files_are_compared_with_the_first(folder: Path, capsys: pytest.CaptureFixture) -> None:
    t = np.arange(50) * 1e-6
    write = "t (s),I_d (A),x\n{}".format
    for name, text in {
        "a": write("\n".join(f"{s},{k % 7},{k % 3}" for k, s in enumerate(t))),
        "b": write("\n".join(f"{2 * s},{k % 7},{k % 3}" for k, s in enumerate(t))),
        "c": write("\n".join(f"{s},{k % 7},{k if k > 9 else ''}" for k, s in enumerate(t))),
        "d": write("\n".join(f"{s},{k},{k % 5}" for k, s in enumerate(t))).replace("(A)", "(mA)"),
        "e": write("\n".join(f"{s},{k % 5},{k % 3}" for k, s in enumerate(t))),
    }.items():
        (folder / f"{name}.csv").write_text(text)
    (folder / "e.csv").write_text((folder / "e.csv").read_text().replace("x", "y", 1))
    assert not ended("inspect", "?.csv")
    stated = capsys.readouterr().out
    assert "b.csv: t: 2e-06 apart" in stated
    assert "c.csv: x: 10 missing" in stated
    assert "d.csv: I_d: mA, taken as I_d in mA" in stated
    assert "e.csv: without x; also y" in stated
    assert "files of one mapping must hold the same names: e.csv differs from a.csv" in stated
    assert "+exp=discover data" not in stated


def test_a_gap_leaves_the_step_as_it_is(folder: Path, capsys: pytest.CaptureFixture) -> None:
    lorenz_csv(folder / "whole.csv")
    lines = (folder / "whole.csv").read_text().splitlines()
    (folder / "a.csv").write_text("\n".join(lines[:204] + lines[704:]))
    step = ep.inspect_file("whole.csv").held[0].step
    assert not ended("inspect", "a.csv")
    stated = capsys.readouterr().out
    assert f"about {step:.4g} apart" in stated
    assert "have a gap: " in stated
    found = computed(composed(
        "+exp=discover", "data=recognised", "data.path=a.csv", "trajectory.states=[x,y,z]",
        "search=best_subset", "selection=ebic", f"output={folder}",
    ))  # fmt: skip
    assert list(found.summary["evaluations"]) == ["model"]
    assert f"500 samples of {SECONDS.duration_text(step, digits=4)} from" in found.log
    assert [text for text in found.warnings if "the record has 1 gap" in text]


@pytest.mark.parametrize(
    ("header", "times", "dt_s", "stated_s"),
    [
        ("t (ms)", 20.0 * np.arange(50), 1.0, "0.02"),
        ("t (ms)", 20.0 * np.arange(50), 0.02, ""),
        ("t", 20.0 * np.arange(50), 0.02, ""),  # ms, which dt_s says
        ("t", 20.0 * np.arange(50), 0.5, "20"),
        ("t (s)", np.round(0.0015 * np.arange(50), 3), 0.0015, ""),  # rounded
        ("t (s)", 0.01 * np.r_[0:25, 100:125], 0.01, ""),  # with a gap
        ("t", np.arange(50.0), 0.02, ""),  # counts the samples
    ],
)
def test_a_step_that_contradicts_the_files_times_is_stated(
    folder: Path, header: str, times: np.ndarray, dt_s: float, stated_s: str
) -> None:
    rows = "\n".join(f"{t:.9g},{k % 7}" for k, t in enumerate(times))
    (folder / "a.csv").write_text(f"{header},V\n{rows}\n")
    with warnings.catch_warnings(record=True) as stated:
        warnings.simplefilter("always")
        field = ep.open_field("a.csv", dt_s=dt_s)
    assert field.time[1] == dt_s  # taken in any case
    texts = [str(each.message) for each in stated if each.category is DoubtfulUnit]
    assert len(texts) == bool(stated_s)
    for text in texts:
        assert f"dt_s={dt_s:g} is taken" in text
        assert f"'t', which go in steps of {stated_s} s" in text


def test_a_step_that_contradicts_a_mapping_is_stated(folder: Path) -> None:
    lorenz_csv(folder / "a.csv")
    mapping = {"variables": {"x": ep.data.Variable("x", "1")}, "dt_s": 3.0}
    with pytest.warns(DoubtfulUnit, match="dt_s=3 is taken"):
        ep.open_field("a.csv", time=ep.data.Variable("Time", "s"), **mapping)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ep.open_field("a.csv", **mapping)


def test_an_experiment_of_one_record_refuses_several(folder: Path) -> None:
    for k in range(2):
        lorenz_csv(folder / f"run{k}.csv", seed=k)
    config = composed(
        "+exp=trace", "data=recognised", "signal=x", "data.path=[run0.csv,run1.csv]",
        f"output={folder}",
    )  # fmt: skip
    with pytest.raises(ValueError, match="takes one record: data.path names 2 files; give one"):
        run_config(config)


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
    words = average.place(known)
    assert words == (
        "average over z 15 to 25 mm (2 of 10 points), the last 40 % of the channel, 25 mm"
    )
    whole = ep.zone_average(known, ep.Zone(z="channel"), states=["n_i"])
    by_hand = ep.zone_average(GRID, ep.Zone(z=(0.0, 0.025)), states=["n_i"])
    np.testing.assert_array_equal(whole.states, by_hand.states)
    words_of_it = ep.data.ZoneAverage(["n_i"], ep.Zone(z="channel")).place(known)
    assert words_of_it == "average over z 0 to 25 mm (5 of 10 points), the channel, 25 mm"
    simulated = GRID.assign_attrs(parameters=json.dumps({"thruster": {"channel_length": 0.025}}))
    assert average.place(simulated) == words
    at_a_point = ep.data.ZoneAverage(["n_i"], ep.Zone(z=0.018)).place(GRID)
    assert at_a_point == "average over z = 17.5 mm (one grid point)"


def test_a_channel_that_is_not_known_is_asked_for() -> None:
    with pytest.raises(ValueError, match=r"give data.channel_m=LENGTH in m, or a zone of your own"):
        ep.zone_average(GRID, ep.Zone(z="downstream"), states=["n_i"])
    flat = GRID.isel(z=0, drop=True)
    assert ep.zone_average(flat, ep.Zone(z="downstream"), states=["n_i"]).n_samples == 5
    with pytest.raises(ValueError, match="in m or one of channel, downstream, got 'upstream'"):
        ep.Zone(z="upstream")


def test_a_variable_that_can_be_made_says_how() -> None:
    field = GRID.assign(T_e_eV=GRID["n_i"])
    with pytest.raises(
        ValueError, match=r"'prepare=\[\{_target_:ep2sindy.thruster.ionization_rate\}\]'"
    ):
        ep.zone_average(field, None, states=["n_i"], inputs=["R_ion"])


def test_every_experiment_on_files_is_known_to_an_inspection() -> None:
    """Those that take the data group; what they need is in their configs."""
    made = {"simulate", "benchmark", "frontier", "weak_windows"}
    assert set(NEEDS) == {*EXPERIMENTS} - made
    for name in ("breathing", "parametric", "pointwise"):
        text = str(composed(f"+exp={name}"))
        assert all(variable in text for variable in NEEDS[name])


def test_a_channel_of_unknown_length_is_looked_for_at_the_magnetic_fields_peak() -> None:
    shape = np.exp(-(((GRID["z"].values - GRID["z"].values[2]) / 5e-3) ** 2))
    field = GRID.assign(B_r=(("z",), 0.02 * shape, {"units": "T"}))
    field.attrs = {k: v for k, v in field.attrs.items() if k not in ("channel_m", "parameters")}
    place = f"{float(GRID['z'][2]):.4g}"
    with pytest.raises(ValueError, match=rf"data.channel_m=LENGTH in m \(B_r is .* at {place} m"):
        ep.zone_average(field, ep.Zone(z="channel"), states=["n_i"])
