"""Tables that are no text: TDMS, and arrays whose names hold their units."""

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
    properties = {"wf_increment": 1.5e-6, "unit_string": "mA"}
    with TdmsWriter(path) as writer:
        writer.write_segment([ChannelObject("Probes", "I_d", X, properties=properties)])


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
