"""A Zarr store from someone else: nothing but numbers is decoded."""

import json
import os
from importlib.metadata import requires
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from numcodecs.pickles import Pickle
from packaging.requirements import Requirement

from ep2sindy import Variable, open_field
from ep2sindy.data.readers import zarr as reader

CANARY = "canary_that_sang"


class Sings:
    """Unpickled, it leaves a mark."""

    def __reduce__(self) -> tuple[object, ...]:
        return eval, (f"__import__('pathlib').Path('{CANARY}').touch()",)


SETTINGS: Any = {"variables": {"I_d": Variable("I", "A")}, "time": Variable("time", "s")}


def store(path: Path, version: int) -> Path:
    data = {"I": ("time", np.arange(5.0), {"units": "A"})}
    field = xr.Dataset(data, coords={"time": 1e-6 * np.arange(5)})
    field.to_zarr(path, consolidated=False, zarr_format=version)
    return path


def changed(path: Path, array: str, **changes: Any) -> None:
    place = next(p for n in reader.METADATA if (p := path / array / n).exists())
    place.write_text(json.dumps(json.loads(place.read_text()) | changes))


def opened(path: Path) -> xr.Dataset:
    return open_field(path, **SETTINGS)


@pytest.mark.parametrize("version", [2, 3])
def test_stores_of_both_formats_are_read(version: int, tmp_path: Path) -> None:
    assert opened(store(tmp_path / "a.zarr", version))["I_d"].values.tolist() == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("array", ["time", "I"])
def test_pickled_objects_are_refused_and_do_not_run(
    array: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    path = store(tmp_path / "a.zarr", 2)
    changed(path, array, dtype="|O", filters=[{"id": "pickle", "protocol": 4}], compressor=None)
    (path / array / "0").write_bytes(Pickle().encode(np.array([Sings()] * 5, dtype=object)))
    with pytest.raises(ValueError, match=rf"{array}/.zarray: an array must be of numbers .*'\|O'"):
        opened(path)
    assert not Path(CANARY).exists()


V2 = [
    {"filters": [{"id": "pickle", "protocol": 4}]},
    {"filters": [{"id": "zlib"}, {"id": "json2"}]},
    {"compressor": {"id": "msgpack2"}},
    {"compressor": {"id": "somebodys"}},
    {"compressor": {}},
    {"compressor": "pickle"},
]
V3 = [
    {"codecs": [{"name": "numcodecs.pickle", "configuration": {}}]},
    {"codecs": ["somebodys"]},
    {"codecs": [{"name": "sharding_indexed", "configuration": {"codecs": [{"name": "mine"}]}}]},
    {"codecs": [{"name": "bytes"}], "storage_transformers": [{"name": "mine"}]},
]


@pytest.mark.parametrize(("version", "changes"), [*((2, c) for c in V2), *((3, c) for c in V3)])
@pytest.mark.parametrize("array", ["time", "I"])
def test_codecs_that_are_not_on_the_list_are_refused_by_name(
    version: int, changes: dict[str, Any], array: str, tmp_path: Path, monkeypatch: Any
) -> None:
    path = store(tmp_path / "a.zarr", version)
    changed(path, array, **changes)
    monkeypatch.setattr(xr, "open_dataset", lambda *_, **__: pytest.fail("it was opened"))
    with pytest.raises(ValueError, match=r"a.zarr cannot be read: .*codecs must be among"):
        opened(path)


OBJECTS = "whose objects may run code when they are read"
UNREAD = "a.zarr cannot be read"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"dtype": "|O"}, OBJECTS),
        ({"dtype": [["a", "<f8"], ["b", "|O"]]}, OBJECTS),
        ({"dtype": {"name": "object"}}, OBJECTS),
        ({"shape": [-5]}, UNREAD),
        ({"chunks": [0]}, UNREAD),
        ({"shape": ["5"]}, UNREAD),
    ],
)
def test_types_that_hold_objects_and_sizes_that_are_none_are_refused(
    changes: dict[str, Any], message: str, tmp_path: Path
) -> None:
    path = store(tmp_path / "a.zarr", 2)
    changed(path, "I", **changes)
    with pytest.raises(ValueError, match=message):
        opened(path)


def test_what_is_no_file_in_a_store_is_refused(tmp_path: Path) -> None:
    """A pipe would be waited for, and a link leads to what is somebody else's."""
    pipe, link = store(tmp_path / "a.zarr", 2), store(tmp_path / "b.zarr", 2)
    os.mkfifo(pipe / "I" / "pipe")
    (link / "I" / "1").symlink_to("/dev/zero")
    for path in (pipe, link):
        with pytest.raises(ValueError, match="is a link, a pipe or a device"):
            opened(path)


@pytest.mark.parametrize("text", ["[]", "{", "null"])
def test_metadata_that_are_none_are_refused(text: str, tmp_path: Path) -> None:
    path = store(tmp_path / "a.zarr", 3)
    (path / "time" / "zarr.json").write_text(text)
    with pytest.raises(ValueError, match="a.zarr cannot be read"):
        opened(path)


def test_numcodecs_that_run_code_are_not_installed_along() -> None:
    found = {r.name: r for r in map(Requirement, requires("ep2sindy") or [])}
    project = (Path(__file__).resolve().parents[1] / "pyproject.toml").read_text()
    assert "numcodecs>=0.16.6" in project
    assert not found.get("numcodecs", Requirement("numcodecs>=0.16.6")).specifier.contains("0.16.5")
