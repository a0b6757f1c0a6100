"""Operating points by the names of files: patterns, proposals, an experiment, and the errors."""

import re
import shlex
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest

from ep2sindy.app.arguments import mend
from ep2sindy.app.schema import study_of
from ep2sindy.data.run_files import FilePattern, propose_pattern
from ep2sindy.operating.law import OperatingLaw
from ep2sindy.studies.points import Study
from tests.models import lienard
from tests.programs import Computed, composed, computed, ended


def touch(*paths: str) -> None:
    for path in map(Path, paths):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()


def test_each_file_is_a_point_in_the_order_of_its_quantities(here: Path) -> None:
    names = ["V1000_m5.csv", "V200_m-4.5e0.csv", "V200_m5.csv", "V200_mold.csv", "V200_m5.csv.gz"]
    touch(*(f"runs/{name}" for name in names))
    points, others = FilePattern("runs/V{V}_m{m}.csv").points()
    assert list(points.items()) == [
        ("runs/V200_m-4.5e0.csv", {"V": 200.0, "m": -4.5}),
        ("runs/V200_m5.csv", {"V": 200.0, "m": 5.0}),
        ("runs/V1000_m5.csv", {"V": 1000.0, "m": 5.0}),
    ]
    assert others == ["runs/V200_mold.csv"]


def test_a_p_between_digits_is_a_decimal_point_and_so_is_a_comma_that_separates_nothing(
    here: Path,
) -> None:
    touch("V2p5_m4,5.csv", "V2p_m4.csv", "V-3p25e1,m4.csv")
    points, others = FilePattern("V{V}_m{m}.csv").points()
    assert points == {"V2p5_m4,5.csv": {"V": 2.5, "m": 4.5}}
    assert others == ["V2p_m4.csv"]
    points, _ = FilePattern("V{V},m{m}.csv").points()
    assert points == {"V-3p25e1,m4.csv": {"V": -32.5, "m": 4.0}}
    assert FilePattern("V{V}p_m{m}.csv").points()[0] == {"V2p_m4.csv": {"V": 2.0, "m": 4.0}}
    touch("a1,2.csv")
    assert FilePattern("a{x},{y}.csv").points()[0] == {"a1,2.csv": {"x": 1.0, "y": 2.0}}


def test_a_pattern_takes_signs_of_the_shell_and_a_quantity_twice(here: Path) -> None:
    touch("V200/a_V200.csv", "V300/b_V300.csv", "V300/b_V200.csv", "V[1]/c_V4.csv")
    points, others = FilePattern("V{V}/?_V{V}.csv").points()
    assert [each["V"] for each in points.values()] == [200.0, 300.0]
    assert others == ["V300/b_V200.csv", "V[1]/c_V4.csv"]
    assert list(FilePattern("V[1]/*_V{V}.csv").points()[0]) == ["V[1]/c_V4.csv"]


@pytest.mark.parametrize(
    ("files", "pattern"),
    [
        (["runs/V200_m4.5.csv", "runs/V300_m5.csv"], "runs/V{V}_m{m}.csv"),
        (["200V_5mgs.csv", "300V_5mgs.csv"], "{V}V_5mgs.csv"),
        (["run_V=200,m=4.csv", "run_V=300,m=5.csv"], "run_V={V},m={m}.csv"),
        (["mdot4p5.csv", "mdot5.csv"], "mdot{mdot}.csv"),
        (["a_-1.csv", "a_2.5e-3.csv"], "a_{a}.csv"),
        (["x1_x2.csv", "x2_x3.csv"], "x{x}_x{x1}.csv"),
        # Names of shots and files, and dates, are no quantities.
        (["shot#101_U=250V.csv", "shot#103_U=300V.csv"], "shot#*_U={U}V.csv"),
        (["run_200V.csv", "run_300V.csv"], "run_{V}V.csv"),
        (["avg_200V.csv", "avg_300V.csv"], "avg_{V}V.csv"),
        (["a7_20240131_120005.csv", "a8_20240201_120006.csv"], "a{a}_*.csv"),
        (["run2_2024-01-31_V7.csv", "run3_2024-02-01_V8.csv"], "run*_*_V{V}.csv"),
        (["Run 12a.csv", "Run 13a.csv"], None),
        (["run12a.csv", "run13a.csv"], None),
        (["V_2024-01-31.csv", "V_2024-02-01.csv"], None),
        (["001.csv", "002.csv"], None),
        (["m4,5.csv", "m4,6.csv"], None),  # one number, or two
    ],
)
def test_a_pattern_is_proposed_where_names_differ_in_numbers(
    files: list[str], pattern: str | None, here: Path
) -> None:
    touch(*files)
    found = propose_pattern(files)
    assert (found and found.text) == pattern
    if found:
        assert sorted(found.points()[0]) == sorted(files)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("runs/a.csv", "need a pattern with a placeholder for each quantity, like 'runs/V"),
        ("runs/{data}.csv", "a placeholder must be .* and not 'data', .*, got 'data'"),
        ("runs/W{V}.csv", r"no file fits .* 1 files next to it: runs/V1.csv \.\.\."),
    ],
)
def test_a_pattern_that_cannot_be_is_refused(text: str, message: str, here: Path) -> None:
    touch("runs/V1.csv")
    with pytest.raises(ValueError, match=message):
        FilePattern(text).points()


@pytest.mark.parametrize(
    "typed",
    [
        "points.files=runs/V{V}_m{m}.csv",
        "points.files='runs/V{V}_m{m}.csv'",
        'points.files="runs/V{V}_m{m}.csv"',
        "points=runs/V{V}_m{m}.csv",
    ],
)
def test_the_pattern_may_be_typed_in_any_form(typed: str) -> None:
    assert mend(typed) == 'points="runs/V{V}_m{m}.csv"'
    assert composed("+exp=parametric", mend(typed)).points == "runs/V{V}_m{m}.csv"
    listed = "points=[{V_D_V: 300, mdot_mg_s: 5}]"
    assert mend(listed) == listed
    assert mend("points.files=[a.csv,b.csv]") == "points=[a.csv,b.csv]"
    assert mend("points.axes=[V,m]") == "points=[{axes: [V,m]}]"


def swing(folder: Path, *values: float) -> None:
    """Lienard's van der Pol over one parameter, by its name."""
    for a in values:
        table = lienard(a).to_dataframe().set_axis(["n_i [m^-3]", "n_n [m^-3]"], axis=1)
        table.to_csv(folder / f"a{a}.csv", index_label="time [s]")


def predicted(folder: Path, terms: str, *more: str) -> Computed:
    return computed(
        composed(
            "+exp=predict", "data=recognised", mend("points.files=a{a}.csv"),
            f"models={{own: {{terms: {terms}}}}}", "law=1", "windows={n_windows: 4, periods: 2.0}",
            "map_points=2", "parallel=serial", f"output={folder}",
            *more,
        )
    )  # fmt: skip


def test_files_make_a_law_over_the_quantity_of_their_names(here: Path) -> None:
    swing(here, 0.6, 0.9, 1.2)
    touch("aold.csv")
    found = predicted(
        here, "{n_i: [n_i,n_n,'n_i^3'], n_n: [n_i]}", "++models.own.known={n_n:{n_i:{1:1.0}}}"
    )
    assert found.report.tables["points"]["a"].tolist() == [0.6, 0.9, 1.2]
    law = OperatingLaw.load(found.folder / "law.json")
    assert law.at(a=1.0).terms("n_i")["n_i"] == pytest.approx(1.0, abs=1e-3)
    assert not [text for text in found.warnings if "is sustained by the law" in text]


def test_an_inspection_of_a_glob_writes_the_list_and_the_command(
    here: Path, capsys: pytest.CaptureFixture
) -> None:
    swing(here, 0.6, 0.9, 1.2)
    assert not ended("inspect", "a*.csv")
    printed = capsys.readouterr().out
    assert "  a=0.6: a0.6.csv\n  a=0.9: a0.9.csv\n  a=1.2: a1.2.csv\n" in printed
    (line,) = re.findall(r"ep2sindy (\+exp=.*)", printed)  # and no experiment on all as one system
    assert line == "+exp=breathing data=recognised 'points.files=a{a}.csv'"


def test_one_signal_at_every_point_is_predicted(here: Path, capsys: pytest.CaptureFixture) -> None:
    for U in (200, 250, 300):
        table = pd.DataFrame({"t [us]": T, "Ibeam [A]": 3.0 + np.sin(U * T), "mdot [mg/s]": 4.6})
        table.to_csv(f"tek{U}V.csv", index=False)
    assert not ended("inspect", "tek*.csv")
    (line,) = re.findall(r"ep2sindy (\+exp=.*)", capsys.readouterr().out)
    typed = shlex.split(line)
    assert typed[:3] == ["+exp=predict", "data=recognised", "points.files=tek{V}V.csv"]
    assert typed[3:] == ["trajectory.states=[Ibeam]"]
    study = study_of(Study, composed(*map(mend, [*typed, OWN])))
    runs = [source.open([]).run for source in study._given.sources]
    assert [run.parameters["V"] for run in runs if run] == [200.0, 250.0, 300.0]


OWN = "models={own: {terms: {Ibeam: ['1']}}}"
T = np.linspace(0.0, 1.0, 60)


def test_files_that_state_their_points_are_points(
    here: Path, capsys: pytest.CaptureFixture
) -> None:
    for k, V in enumerate((200, 250, 300)):
        table = pd.DataFrame({"t [us]": T, "Ibeam [A]": np.sin(V * T), "V_d [V]": V, "mdot": 4.6})
        table.to_csv(f"shot_{k}.csv", index=False)
    assert not ended("inspect", "shot_*.csv")
    (line,) = re.findall(r"ep2sindy (\+exp=.*)", capsys.readouterr().out)
    typed = shlex.split(line)
    assert typed[2:] == [
        "points.files=shot_*.csv", "+parameters={V_d:null}", "trajectory.states=[Ibeam]",
    ]  # fmt: skip
    study = study_of(Study, composed(*map(mend, [*typed, OWN])))
    points = [dict(source.parameters) for source in study._given.sources]
    assert points == [{"V_d": 200.0}, {"V_d": 250.0}, {"V_d": 300.0}]


def test_a_grid_of_densities_without_units_is_breathing_if_you_say_so(
    here: Path, capsys: pytest.CaptureFixture
) -> None:
    wave = 2.0 + np.sin(9.0 * T[:, None] + np.arange(4))
    for U in (200, 250):
        with h5py.File(f"pic_U{U}.h5", "w") as file:
            file["moments/ne"], file["moments/nn"] = 1e17 * wave, 1e19 * wave[::-1]
            file["x"], file["time"] = np.arange(4.0), T
    assert not ended("inspect", "pic*.h5")
    (line,) = re.findall(r"ep2sindy (\+exp=.*)", capsys.readouterr().out)
    assert shlex.split(line) == [
        "+exp=breathing", "data=recognised", "data.plasma=true", "data.z={name:x,unit:UNIT}",
        "data.units={time:UNIT,n_i:UNIT,n_n:UNIT}", "points.files=pic_U{U}.h5",
        "data.channel_m=LENGTH",
    ]  # fmt: skip
