"""Tables that are no text: Excel, Parquet, TDMS, and arrays whose names hold their units."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from nptdms import ChannelObject, TdmsWriter

import ep2sindy as ep
from ep2sindy.data.fields import clock_of
from ep2sindy.data.runs import trajectories_of

T = np.arange(40) * 1.5e-6
X = 2.0 + np.sin(1e5 * T)
TABLE = pd.DataFrame({"Time (us)": 1e6 * T, "I_d [mA]": X, "note": ["ok"] * len(T)})


def write_excel(path: Path) -> None:
    TABLE.to_excel(path, index=False)


def write_sheet_of_a_lab(path: Path) -> None:
    """A title, a line of units, an error value, and a sheet of notes."""
    cells = [["Run 12", "", ""], ["", "", ""], ["Time", "I_d", "note"], ["(us)", "(mA)", ""]]
    cells += TABLE.values.tolist()
    with pd.ExcelWriter(path) as book:
        pd.DataFrame([["by hand"]]).to_excel(book, sheet_name="notes", header=False, index=False)
        pd.DataFrame(cells).to_excel(book, sheet_name="run", header=False, index=False)


def write_parquet(path: Path) -> None:
    TABLE.to_parquet(path)


def write_indexed_parquet(path: Path) -> None:
    TABLE.set_index("Time (us)").to_parquet(path)


def write_tdms(path: Path) -> None:
    stated = {"wf_increment": 1.5e-6, "unit_string": "mA"}
    with TdmsWriter(path) as writer:
        writer.write_segment([ChannelObject("Probes", "I_d", X, properties=stated)])


def write_tdms_of_named_units(path: Path) -> None:
    with TdmsWriter(path) as writer:
        columns = [ChannelObject("Probes", name, TABLE[name].to_numpy()) for name in NAMED]
        writer.write_segment(columns)


def write_npz_of_named_units(path: Path) -> None:
    np.savez(path, **{name: TABLE[name].to_numpy() for name in NAMED})


NAMED = ("Time (us)", "I_d [mA]")
KINDS = {
    "a.xlsx": write_excel,
    "lab.xlsx": write_sheet_of_a_lab,
    "a.parquet": write_parquet,
    "index.parquet": write_indexed_parquet,
    "a.tdms": write_tdms,
    "named.tdms": write_tdms_of_named_units,
    "named.npz": write_npz_of_named_units,
}


@pytest.mark.parametrize("name", KINDS)
def test_a_table_is_opened_with_its_units(tmp_path: Path, name: str) -> None:
    KINDS[name](tmp_path / name)
    field = ep.open_field(tmp_path / name)
    assert list(field.data_vars) == ["I_d"]
    np.testing.assert_allclose(field["time"].values, T, rtol=1e-12, atol=1e-20)
    np.testing.assert_allclose(field["I_d"].values, 1e-3 * X, rtol=1e-12)


@pytest.mark.parametrize("ending", ["csv", "xlsx", "parquet"])
@pytest.mark.parametrize(("freq", "unit"), [("D", "day"), ("10min", "min"), ("10ms", "s")])
def test_dates_are_counted_from_the_first(
    tmp_path: Path, ending: str, freq: str, unit: str
) -> None:
    dates = pd.date_range("2024-01-01", periods=len(X), freq=freq)
    table = pd.DataFrame({"x": X}, index=dates)
    {"csv": table.to_csv, "xlsx": table.to_excel, "parquet": table.to_parquet}[ending](
        tmp_path / f"a.{ending}"
    )
    time = ep.inspect_file(tmp_path / f"a.{ending}").time
    assert time is not None
    assert time.unit == unit
    expected = (dates - dates[0]).total_seconds()
    np.testing.assert_allclose(
        ep.open_field(tmp_path / f"a.{ending}")["time"].values, expected, rtol=1e-12
    )


def test_durations_are_times(tmp_path: Path) -> None:
    table = pd.DataFrame({"x": X}, index=pd.timedelta_range(0, periods=len(X), freq="2h"))
    table.to_parquet(tmp_path / "a.parquet")
    field = ep.open_field(tmp_path / "a.parquet")
    (run,) = trajectories_of(table)
    np.testing.assert_allclose(field["time"].values, run.t, rtol=1e-12)
    assert clock_of(field) == run.clock == ep.library.Clock.of("h")


def test_columns_of_several_sheets_bear_the_sheets_name(tmp_path: Path) -> None:
    with pd.ExcelWriter(tmp_path / "a.xlsx") as book:
        TABLE.to_excel(book, sheet_name="one", index=False)
        TABLE.to_excel(book, sheet_name="two", index=False)
    with pytest.raises(ValueError, match="time may be 'one/Time' or 'two/Time': name one"):
        ep.open_field(tmp_path / "a.xlsx")
    field = ep.open_field(
        tmp_path / "a.xlsx",
        variables={"I_d": ep.data.Variable("two/I_d", "mA")},
        time=ep.data.Variable("two/Time", "us"),
    )
    np.testing.assert_allclose(field["I_d"].values, 1e-3 * X, rtol=1e-12)


@pytest.mark.parametrize("part", [0.3, 0.6, 0.9])
def test_damaged_parquet_ends_in_one_message(tmp_path: Path, part: float) -> None:
    write_parquet(tmp_path / "a.parquet")
    content = bytearray((tmp_path / "a.parquet").read_bytes())
    place = int(part * len(content))
    content[place : place + 64] = bytes(64)
    (tmp_path / "a.parquet").write_bytes(content)
    with pytest.raises(ValueError, match="a.parquet cannot be read: "):
        ep.open_field(tmp_path / "a.parquet")


def test_an_array_of_numpy_is_opened(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.column_stack([X, 2 * X]))
    field = ep.open_field(tmp_path / "a.npy", dt_s=1.5e-6)
    np.testing.assert_array_equal(field["column_1"].values, 2 * X)
    named = np.rec.fromarrays([1e6 * T, X], names="t_us,x")
    np.save(tmp_path / "b.npy", named)
    np.testing.assert_allclose(ep.open_field(tmp_path / "b.npy")["time"].values, T, atol=1e-18)


LVM = """LabVIEW Measurement\t
Writer_Version\t2
Separator\tTab
X_Dimension\tTime\t
X0\t0.0\t
Delta_X\t0.0000015\t
***End_of_Header***\t\t
X_Value\tVoltage\tComment
"""


def test_a_measurement_file_of_labview_is_read(tmp_path: Path) -> None:
    rows = "".join(f"{t:.7f}\t{x:.6f}\t\n" for t, x in zip(T, X, strict=True))
    (tmp_path / "a.lvm").write_text(LVM + rows)
    field = ep.open_field(tmp_path / "a.lvm", time=ep.data.Variable("X_Value", "s"))
    np.testing.assert_allclose(field["Voltage"].values, X, atol=1e-6)
