"""The face: what users import and configs name."""

from importlib import import_module
from pathlib import Path

import pytest
import yaml

import ep2sindy as ep
from ep2sindy._stubs import MARK, PACKAGE, dotted_names, read_stub, subpackages
from ep2sindy.app.targets import FOR_CONFIGS

ROOT = Path(__file__).resolve().parents[1]
STUBS = sorted((ROOT / PACKAGE).rglob("*.pyi"))


def test_every_name_of_a_stub_is_loaded_as_it_says() -> None:
    for room in subpackages():
        module = import_module(room)
        assert dir(module) == sorted(read_stub(room))
        for name, entry in read_stub(room).items():
            value = getattr(module, name)
            assert value is getattr(import_module(entry.module), entry.name)
            home = value.__module__ if isinstance(value, type) else entry.module
            assert home == entry.module, f"{room}.{name} is defined elsewhere"
            assert name == entry.name, f"type checkers take {name} for no name of {room}"
    assert len(STUBS) == len(subpackages())


def test_a_name_stands_in_one_stub_and_hides_no_module() -> None:
    names = [name.rpartition(".")[2] for name in dotted_names()]
    assert len(names) == len(set(names))
    places = [ROOT.joinpath(*name.split(".")) for name in dotted_names()]
    assert not [place for place in places if place.is_dir() or place.with_suffix(".py").exists()]


def test_a_mark_is_written_as_it_is_read() -> None:
    """Nothing else stands behind a name, so that no mark is misspelt."""
    lines = [line for path in STUBS for line in path.read_text("utf-8").splitlines()]
    assert {t[t.index("#") :] for t in lines if "#" in t and not t.startswith("# ")} == {MARK}


@pytest.mark.parametrize(
    ("room", "name", "message"),
    [
        (
            "ep2sindy",
            "Eebic",
            r"no attribute 'Eebic'; see dir\(ep2sindy\) \(did you mean .*ep2sindy.EBIC",
        ),
        (
            "ep2sindy.thruster",
            "crop",
            r"dir\(ep2sindy.thruster\) \(did you mean .*data.crop\?\)$",
        ),
        ("ep2sindy", "_nothing", r"no attribute '_nothing'; see dir\(ep2sindy\)$"),
    ],
)
def test_an_unknown_name_says_where_to_look(room: str, name: str, message: str) -> None:
    with pytest.raises(AttributeError, match=message):
        getattr(import_module(room), name)


def test_the_version_is_the_one_installed() -> None:
    assert ep.__version__.count(".") == 2


def targets(node: object) -> set[str]:
    """Every `_target_` below a node of a config."""
    if isinstance(node, list):
        return {found for each in node for found in targets(each)}
    if not isinstance(node, dict):
        return set()
    own = {node["_target_"]} if "_target_" in node else set()
    return own | {found for each in node.values() for found in targets(each)}


def test_configs_name_what_is_for_configs() -> None:
    paths = [p for p in (ROOT / "conf").rglob("*.yaml") if "hydra" not in p.parts]
    contents = [yaml.safe_load(path.read_text()) for path in paths]
    found = {name for each in contents for name in targets({**each, "hydra": None})}
    assert found
    ours = {name for name in found if not name.startswith("benchmarks.")}  # those of a checkout
    assert ours <= FOR_CONFIGS
