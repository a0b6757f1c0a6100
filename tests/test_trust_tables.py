"""Tables, packed arrays and JSON of other people: read as what they are, or refused by name."""

import json
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray as xr

import ep2sindy as ep
from ep2sindy.data.readers import tables
from ep2sindy.data.readers.registry import open_source
from ep2sindy.trust import memory

X = np.arange(20) * 250.5  # below a thousand, and above


def table(*cells: Callable[[float], str], sep: str) -> str:
    lines = [sep.join([str(k), *(text(x) for text in cells)]) for k, x in enumerate(X)]
    return "\n".join([sep.join(["t", *(f"x{j}" for j, _ in enumerate(cells))]), *lines]) + "\n"


def english(x: float) -> str:
    return f"{x:,.1f}"


def german(x: float) -> str:
    return f"{x:,.1f}".translate(str.maketrans(",.", ".,"))


def spaced(x: float) -> str:
    return f"{x:,.1f}".translate(str.maketrans(",.", "\u00a0,"))


@pytest.mark.parametrize(
    ("text", "sep"),
    [
        (english, "\t"), (english, ";"), (german, "\t"), (german, ";"), (spaced, ";"),
        (lambda x: f'"{english(x)}"', ","), (lambda x: f'"{german(x)}"', ","),
        (lambda x: f"{x:,.1f}".replace(",", "'"), ";"),
        (lambda x: f"{x:.1f}".replace(".", ","), ";"), (lambda x: f"{x:.1f}", ","),
    ],
)  # fmt: skip
def test_numbers_are_read_with_and_without_marks_of_thousands(
    text: Callable[[float], str], sep: str, tmp_path: Path
) -> None:
    (tmp_path / "a.csv").write_text(table(text, text, sep=sep))
    source = open_source(tmp_path / "a.csv")
    assert source.names == ["t", "x0", "x1"]
    for name in ("x0", "x1"):
        np.testing.assert_array_equal(source.read(name).values, X)
    assert ("marks between thousands" in source.words) == (len(text(1000.5).strip('"')) > 6)


AMBIGUOUS = {
    "thousands or decimals": (
        "t\tx\n" + "".join(f"{k}\t1,{k:03d}\n" for k in range(9)),
        "'1,000' may be 1.000 or 1000, and no number of the file tells which",
    ),
    "a word in the second row": ("t,x\n0,1\n1,bad\n2,4\n3,5\n", "line 3 is '1,bad'"),
    "names that no number helps": (
        "t,x,x,x.1\n" + "0,1,2,3\n" * 5, "must have names of their own: 'x.1' comes more than once",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", AMBIGUOUS)
def test_what_may_be_read_in_two_ways_is_refused(case: str, tmp_path: Path) -> None:
    text, message = AMBIGUOUS[case]
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(ValueError, match=f"(?s)a.csv cannot be read: .*{message}"):
        ep.inspect_file(tmp_path / "a.csv")


ROWS = "".join(f"{k},{2 * k}\n" for k in range(9))


@pytest.mark.parametrize(
    ("above", "names", "units", "first"),
    [
        ("t,x\ns,A\n", ["t", "x"], ["s", "A"], [0.0, 0.0]),
        ("t,x\nsec,a.u.\n", ["t", "x"], ["sec", ""], [0.0, 0.0]),
        ("t,x\n-1,n/a\n", ["t", "x"], ["", ""], [-1.0, np.nan]),
    ],
)
def test_units_and_missing_samples_below_a_header_cost_no_name_and_no_row(
    above: str, names: list[str], units: list[str], first: list[float], tmp_path: Path
) -> None:
    (tmp_path / "a.csv").write_text(above + ROWS)
    source = open_source(tmp_path / "a.csv")
    arrays = [source.read(name) for name in names]
    assert list(source.names) == names
    assert [array.attrs["units"] for array in arrays] == units
    np.testing.assert_array_equal([array.values[0] for array in arrays], first)
    assert arrays[1].values[-9:].tolist() == [2.0 * k for k in range(9)]


def test_columns_of_one_name_are_numbered_and_none_is_taken_for_the_name(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t,x,x\n" + "".join(f"{k},{k**2},7\n" for k in range(9)))
    found = ep.inspect_file(tmp_path / "a.csv")
    assert [each.name for each in found.held] == ["t", "x.0", "x.1"]
    with pytest.raises(ValueError, match=r"no variable 'x' .*it holds t \(9\), x\.0 \(9\), x\.1"):
        ep.open_field(tmp_path / "a.csv", variables={"x": ep.data.Variable("x", "1")}, dt_s=1.0)


def written(path: Path, *, time: str = "s", **packing: object) -> Path:
    """Two arrays; packing: attributes of x."""
    t, x = np.arange(5.0), np.arange(5, dtype="i2")
    if path.suffix == ".h5":
        with h5py.File(path, "w") as file:
            file["time"], file["x"] = t, x
            file["time"].attrs["units"] = time
            file["x"].attrs.update(packing)
        return path
    coords = {"time": ("time", t, {"units": time})}
    dataset = xr.Dataset({"x": ("time", x, packing)}, coords=coords)
    if path.suffix == ".zarr":
        dataset.to_zarr(path, consolidated=False, zarr_format=2)
    else:
        dataset.to_netcdf(path, engine="scipy")
    return path


KINDS = [".nc", ".h5", ".zarr"]
PLAIN = {"x": ep.data.Variable("x", "1")}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("scale_factor", 0.0),
        ("add_offset", np.nan),
    ],
)  # fmt: skip
def test_packing_that_leaves_no_numbers_is_refused_with_its_attribute(
    kind: str, key: str, value: object, tmp_path: Path
) -> None:
    path = written(tmp_path / f"a{kind}", **{key: value})
    with pytest.raises(ValueError, match=f"a{kind} cannot be read: {key} of 'x' must be a finite"):
        ep.open_field(path, variables=PLAIN, time=ep.data.Variable("time", "s"))
    assert ep.inspect_file(path).time is not None  # the other array is read


@pytest.mark.parametrize("kind", KINDS)
def test_sound_packing_is_undone(kind: str, tmp_path: Path) -> None:
    path = written(tmp_path / f"a{kind}", scale_factor=np.array([0.5]), add_offset=1.0)
    field = ep.open_field(path, variables=PLAIN, time=ep.data.Variable("time", "s"))
    assert field["x"].values.tolist() == [1.0, 1.5, 2.0, 2.5, 3.0]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("time", ["days since 2000-01-01", "days"])
def test_days_are_no_seconds(kind: str, time: str, tmp_path: Path) -> None:
    path = written(tmp_path / f"a{kind}", time=time)
    with pytest.raises(ValueError, match=f"the mapping says 's', the file '{time}'"):
        ep.open_field(path, variables=PLAIN, time=ep.data.Variable("time", "s"))
    for given in (ep.data.Variable("time", "days"), ep.inspect_file(path).time):
        field = ep.open_field(path, variables=PLAIN, time=given)
        assert field["time"].values[:2].tolist() == [0.0, 86400.0]


def test_a_table_of_thousands_of_columns_is_read(tmp_path: Path) -> None:
    n = 3000
    names = ",".join(f"c{k}" for k in range(n))
    row = ",".join(f"{k}.5" for k in range(n))
    (tmp_path / "a.csv").write_text(f"t,{names}\n" + "".join(f"{k},{row}\n" for k in range(4)))
    assert open_source(tmp_path / "a.csv").read("c2999").values.tolist() == [2999.5] * 4


def test_a_table_has_a_width_that_is_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a.csv").write_text(("1," * 5000 + "1\n") * 4)
    with pytest.raises(ValueError, match=r"a\.csv cannot be read: .*most 5000 columns, got 5001"):
        open_source(tmp_path / "a.csv")
    np.savez(tmp_path / "a.npz", **{f"x{k}": np.ones(2) for k in range(3)})
    monkeypatch.setattr(memory.check_width, "__defaults__", (2,))
    with pytest.raises(ValueError, match="must have at most 2 arrays, got 3: keep what you need"):
        ep.inspect_file(tmp_path / "a.npz")
    (tmp_path / "a.csv").write_text("t,x\n" + "1,2\n" * 9 + "," * (tables.MAX_LOOKED_AT + 1))
    with pytest.raises(ValueError, match="at most 2097152 characters in a line, got 2097153"):
        open_source(tmp_path / "a.csv")


def twice(text: str, key: str) -> str:
    return text.replace(f'"{key}":', f'"{key}": [], "{key}":', 1)


def test_a_key_that_comes_twice_is_refused_in_models_and_records(tmp_path: Path) -> None:
    model = tmp_path / "model.json"
    model.write_text(twice(ep.lorenz().model.to_json(), "states"))
    with pytest.raises(ValueError, match="each key once: 'states'"):
        ep.SparseModel.load(model)
    record = tmp_path / "a.json"
    record.write_text(twice(json.dumps({"config": {}, "t": [0, 1], "x": [1, 2]}), "t"))
    with pytest.raises(ValueError, match="each key once: 't'"):
        ep.inspect_file(record)
