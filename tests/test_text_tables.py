"""Tables as text, in the layouts of oscilloscopes, programs and people."""

from pathlib import Path

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.data.fields import clock_of
from ep2sindy.data.readers.registry import open_source

T = np.arange(30) * 1.5e-6
X = 4.0 + np.sin(np.arange(30) / 3)


def rows(*columns: np.ndarray, sep: str = ",", decimal: str = ".", end: str = "") -> str:
    lines = [sep.join(f"{v:.9g}".replace(".", decimal) for v in row) for row in zip(*columns)]  # noqa: B905
    return "\n".join(line + end for line in lines) + "\n"


# text, then the names, the units and the factor of the time column
LAYOUTS = {
    "commas": ("t,I\n" + rows(T, X), ["t", "I"], ["", ""], 1.0),
    "no header": (rows(T, X), ["0", "1"], ["", ""], 1.0),
    "tabs and decimal commas": (
        "t\tI\n" + rows(T, X, sep="\t", decimal=","), ["t", "I"], ["", ""], 1.0,
    ),
    "numpy.savetxt": ("# t I\n" + rows(T, X, sep=" "), ["t", "I"], ["", ""], 1.0),
    "Fortran": ("\n" + rows(T, X, sep=" ").replace("e", "D"), ["0", "1"], ["", ""], 1.0),
    "PicoScope": (
        "Time;Channel A\n(us);(A)\n\n" + rows(1e6 * T, X, sep=";", decimal=","),
        ["Time", "Channel A"], ["us", "A"], 1e6,
    ),
    "Tektronix MSO": (
        "Model,MSO44\nFirmware,1.2\n\nHorizontal Scale,4e-6\n\n\nTIME,CH1\n" + rows(T, X),
        ["TIME", "CH1"], ["", ""], 1.0,
    ),
    "Tektronix TDS": (
        "".join(
            f"{head},{t:.9g},{x:.9g},\n"
            for head, t, x in zip(
                ["Record Length,30,", "Sample Interval,1.5e-6,", "Source,CH1,", *[",,"] * 27],
                T, X, strict=True,
            )
        ),
        ["3", "4"], ["", ""], 1.0,
    ),
    "Keysight": (
        "x-axis,1\nsecond,Ampere\n" + rows(T, X), ["x-axis", "1"], ["second", "ampere"], 1.0,
    ),
    "LeCroy": (
        "LECROYWR104Xi,6262,Waveform\nSegments,1,SegmentSize,2002\nSegment,TrigTime,Time\n"
        "#1,06-May-2010 11:11,0\nTime,Ampl\n" + rows(T, X),
        ["Time", "Ampl"], ["", ""], 1.0,
    ),
    "units in names": (
        "time (us);I [A]\n" + rows(1e6 * T, X, sep=";"), ["time", "I"], ["us", "A"], 1e6,
    ),
    "quotes": (
        '"t","I"\n' + rows(T, X).replace(",", '","').replace("\n", '"\n"')[:-1].join(['"', ""]),
        ["t", "I"], ["", ""], 1.0,
    ),
    "a column of text": (
        "t,I,note\n" + rows(T, X, end=",ok"), ["t", "I"], ["", ""], 1.0,
    ),
}  # fmt: skip


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_layouts_are_told_from_their_content(tmp_path: Path, layout: str, encoding: str) -> None:
    text, names, units, factor = LAYOUTS[layout]
    (tmp_path / "a.txt").write_text(text, encoding=encoding)
    source = open_source(tmp_path / "a.txt")
    assert list(source.names) == names
    arrays = [source.read(name) for name in names]
    assert [array.attrs["units"] for array in arrays] == units
    np.testing.assert_allclose(arrays[0].values, factor * T, rtol=1e-8, atol=1e-14)
    np.testing.assert_allclose(arrays[1].values, X, rtol=1e-8)


def test_rigol_counts_its_samples_and_says_the_step_next_to_the_names(tmp_path: Path) -> None:
    text = "X,CH1,Start,Increment,\nSequence,Volt,-6.0e-03,1.5e-06\n"
    (tmp_path / "a.csv").write_text(text + rows(np.arange(30), X, end=","))
    field = ep.open_field(tmp_path / "a.csv")
    np.testing.assert_allclose(field["time"].values, T, atol=1e-18)
    np.testing.assert_allclose(field["CH1"].values, X, rtol=1e-8)
    assert field["CH1"].attrs["units"] == "V"


def test_a_preamble_says_the_step_of_a_file_without_time(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("Sample Interval,1.5e-06\nI_d\n" + rows(X))
    field = ep.open_field(tmp_path / "a.csv")
    np.testing.assert_allclose(field["time"].values, T, rtol=1e-12)
    np.testing.assert_allclose(field["I_d"].values, X, rtol=1e-8)


def test_empty_cells_and_words_for_missing_are_nan(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t,x,y\n0,1,2\n1,,3\n2,4,NaN\n3,5,---\n4,6,inf\n5,7,8\n")
    source = open_source(tmp_path / "a.csv")
    np.testing.assert_array_equal(source.read("x").values, [1, np.nan, 4, 5, 6, 7])
    np.testing.assert_array_equal(source.read("y").values, [2, 3, *[np.nan] * 3, 8])


MANY = rows(np.arange(3000.0), np.arange(3000.0))
FAULTS = {
    "one more in some row": ("t,x\n0,1\n1,2,5\n2,3\n3,4\n", "rows have 3 columns"),
    "one more far below": (
        f"t,x\n{MANY}3000,1,7\n", "as many cells as the first, 2: row 3001 has 3",
    ),
    "a word far below": (f"t,x\n{MANY}3000,over\n", "'x' must hold numbers: row 3001 holds 'over'"),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_of_a_table_are_named(tmp_path: Path, fault: str) -> None:
    text, message = FAULTS[fault]
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(ValueError, match=f"a.csv cannot be .*{message}"):
        ep.open_field(tmp_path / "a.csv")


def test_a_unit_in_the_header_must_agree_with_the_mapping(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t (us),n (cm^-3)\n" + rows(1e6 * T, 1e12 * X))
    with pytest.raises(ValueError, match=r"(?s)2 things .*the file 'cm\^-3'.*the file 'us'"):
        ep.open_field(
            tmp_path / "a.csv",
            variables={"n_i": ep.data.Variable("n", "m^-3")},
            time=ep.data.Variable("t", "s"),
        )


TEKTRONIX = (
    "Model,MSO54\nHorizontal Units,S,\nSample Interval,1.5e-06,\nRecord Length,30,\n"
    "Vertical Units,mV,\n,,\nLabel,,\nTIME,CH1,\n"
)


def tektronix(path: Path, times: np.ndarray) -> Path:
    path.write_text(TEKTRONIX + rows(times, X, end=","))
    return path


def test_units_of_a_preamble_are_those_of_the_columns(tmp_path: Path) -> None:
    field = ep.open_field(tektronix(tmp_path / "a.csv", T))
    np.testing.assert_allclose(field["CH1"].values, 1e-3 * X, rtol=1e-8)
    assert field["CH1"].attrs["units"] == "V"
    assert ep.inspect_file(tmp_path / "a.csv").time == ep.data.Variable("TIME", "s")


def test_rounded_times_take_the_step_of_the_preamble(tmp_path: Path) -> None:
    path = tektronix(tmp_path / "a.csv", np.round(T, 5))
    np.testing.assert_allclose(ep.open_field(path)["time"].values, T, atol=1e-18)


def test_stretches_that_a_file_joins_are_not_made_even(tmp_path: Path) -> None:
    path = tektronix(tmp_path / "a.csv", np.concatenate([T[:15], T[:15]]))
    with pytest.raises(ValueError, match="give dt_s if the steps are equal, or the segments as"):
        ep.open_field(path)


@pytest.mark.parametrize(
    ("name", "unit", "seconds"),
    [
        ("Year", "year", 31557600.0), ("day", "day", 86400.0), ("Time (h)", "h", 3600.0),
        ("t_min", "min", 60.0),
    ],
)  # fmt: skip
def test_the_name_of_a_column_says_the_unit_of_time(
    tmp_path: Path, name: str, unit: str, seconds: float
) -> None:
    (tmp_path / "a.csv").write_text(f"{name},x\n" + rows(np.arange(30.0), X))
    time = ep.inspect_file(tmp_path / "a.csv").time
    assert time is not None
    assert time.unit == unit
    field = ep.open_field(tmp_path / "a.csv")
    np.testing.assert_allclose(field["time"].values, seconds * np.arange(30.0), rtol=1e-12)
    assert clock_of(field).unit == unit


def test_a_first_column_of_another_name_is_no_time_unless_the_user_says_so(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("frame,x\n" + rows(np.arange(30.0), X))
    (note,) = ep.inspect_file(tmp_path / "a.csv").notes()
    assert note == "a field needs time: give the step between samples, data.dt_s=STEP in s"


def test_the_whole_file_decides_which_columns_are_kept(tmp_path: Path) -> None:
    """A column may end long before the others, or begin beyond the lines that are looked at."""
    n = 3000
    ends, begins = (["1.5"] * 50 + [""] * (n - 50)), ([""] * 2500 + ["2.5"] * (n - 2500))
    lines = [f"{k},{a},{b}" for k, (a, b) in enumerate(zip(ends, begins, strict=True))]
    (tmp_path / "a.csv").write_text("t_s,ends,begins\n" + "\n".join(lines) + "\n")
    held = {each.name: each for each in ep.inspect_file(tmp_path / "a.csv").held}
    assert (held["ends"].n_missing, held["begins"].n_missing) == (n - 50, 2500)


@pytest.mark.parametrize(
    "stamps",
    [
        ["2024-01-31,11:59:58", "2024-01-31,11:59:59.5", "2024-01-31,12:00:01"],
        ["2024-01-31,11:59:58 AM", "2024-01-31,11:59:59.5 AM", "2024-01-31,12:00:01 PM"],
        ["2024-01-31 11:59:58 AM,", "2024-01-31 11:59:59.5 AM,", "2024-01-31 12:00:01 PM,"],
    ],
)
def test_the_time_of_day_may_stand_next_to_the_date(tmp_path: Path, stamps: list[str]) -> None:
    lines = [f"{stamp},{k % 2}" for k, stamp in enumerate(stamps)]
    (tmp_path / "a.csv").write_text("date,clock,x\n" + "\n".join(lines) + "\n")
    np.testing.assert_allclose(ep.open_field(tmp_path / "a.csv")["time"].values, [0.0, 1.5, 3.0])


def test_a_unit_with_a_factor_stands_in_the_name(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t [us],plasma dens. [1e17 m^-3],c (mM)\n" + rows(T, X, X))
    field = ep.open_field(tmp_path / "a.csv")
    np.testing.assert_allclose(field["n_i"].values, 1e17 * X, rtol=1e-8)
    assert ep.inspect_file(tmp_path / "a.csv").variables["c"].unit == "mM"
