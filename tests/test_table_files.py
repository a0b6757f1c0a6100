"""Tables that are no text: TDMS, and arrays whose names hold their units."""

from importlib import util
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from nptdms import ChannelObject, TdmsWriter

import ep2sindy as ep

T = np.arange(40) * 1.5e-6
X = 2.0 + np.sin(1e5 * T)
TABLE = pd.DataFrame({"Time (us)": 1e6 * T, "I_d [mA]": X, "note": ["ok"] * len(T)})


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


@pytest.mark.parametrize(("freq", "unit"), [("D", "day"), ("10min", "min"), ("10ms", "s")])
def test_dates_are_counted_from_the_first(tmp_path: Path, freq: str, unit: str) -> None:
    dates = pd.date_range("2024-01-01", periods=len(X), freq=freq)
    table = pd.DataFrame({"x": X}, index=dates)
    table.to_csv(tmp_path / "a.csv")
    time = ep.inspect_file(tmp_path / "a.csv").time
    assert time is not None
    assert time.unit == unit
    expected = (dates - dates[0]).total_seconds()
    np.testing.assert_allclose(
        ep.open_field(tmp_path / "a.csv")["time"].values, expected, rtol=1e-12
    )


def test_dates_that_may_be_read_in_two_ways_are_left_out(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("date,x\n01/02/2024,1\n02/02/2024,3\n03/02/2024,2\n")
    found = ep.inspect_file(tmp_path / "a.csv")
    assert "left out: date; dates are read if written as 2024-01-31" in found.source.words
    assert list(found.variables) == ["x"]


def test_an_archive_of_other_files_is_no_npz(tmp_path: Path) -> None:
    with ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.writestr("run.csv", "t,x\n0,1\n")
    with pytest.raises(ValueError, match=r"arrays of NumPy alone: it holds 'run.csv'; unpack it"):
        ep.inspect_file(tmp_path / "a.zip")


def test_a_missing_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_tdms(tmp_path / "a.tdms")
    monkeypatch.setattr("ep2sindy.data.readers.registry.find_spec", lambda package: None)
    assert util.find_spec("pandas")  # the patch is of that module's name alone
    with pytest.raises(ValueError, match=r"an extra reads: pip install 'ep2sindy\[files\]', or"):
        ep.inspect_file(tmp_path / "a.tdms")


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


def test_a_measurement_file_of_labview_asks_for_its_time_alone(tmp_path: Path) -> None:
    rows = "".join(f"{t:.7f}\t{x:.6f}\t\n" for t, x in zip(T, X, strict=True))
    (tmp_path / "a.lvm").write_text(LVM + rows)
    with pytest.raises(
        ValueError, match=r"if 'X_Value' is time, 'data.time=\{name:X_Value,unit:UN"
    ):
        ep.open_field(tmp_path / "a.lvm")
    field = ep.open_field(tmp_path / "a.lvm", time=ep.data.Variable("X_Value", "s"))
    np.testing.assert_allclose(field["Voltage"].values, X, atol=1e-6)
