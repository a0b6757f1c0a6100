"""The face: what users import and configs name."""

import ast
import inspect
import re
import subprocess
import sys
import warnings
from functools import reduce
from importlib import import_module
from pathlib import Path

import pytest
import yaml
from omegaconf import OmegaConf

import ep2sindy as ep
from ep2sindy._old_names import GONE, NOTES, RENAMED, gone_text
from ep2sindy._stubs import MARK, PACKAGE, dotted_names, read_stub, rooms
from ep2sindy.app.schema import bind_step
from ep2sindy.app.targets import FOR_CONFIGS, check_targets, target_of

ROOT = Path(__file__).resolve().parents[1]
STUBS = sorted((ROOT / PACKAGE).rglob("*.pyi"))
N_OLD = 195


def test_every_name_of_a_stub_is_loaded_as_it_says() -> None:
    for room in rooms():
        module = import_module(room)
        assert dir(module) == sorted(read_stub(room))
        for name, entry in read_stub(room).items():
            value = getattr(module, name)
            assert value is getattr(import_module(entry.module), entry.name)
            home = value.__module__ if isinstance(value, type) else entry.module
            assert home == entry.module, f"{room}.{name} is defined elsewhere"
            assert name == entry.name, f"type checkers take {name} for no name of {room}"
    assert len(STUBS) == len(rooms())


def test_a_name_stands_in_one_stub_and_hides_no_module() -> None:
    names = [name.rpartition(".")[2] for name in dotted_names()]
    assert len(names) == len(set(names))
    places = [ROOT.joinpath(*name.split(".")) for name in dotted_names()]
    assert not [place for place in places if place.is_dir() or place.with_suffix(".py").exists()]


def test_a_mark_is_written_as_it_is_read() -> None:
    """Nothing else stands behind a name, so that no mark is misspelt."""
    lines = [line for path in STUBS for line in path.read_text("utf-8").splitlines()]
    assert {t[t.index("#") :] for t in lines if "#" in t and not t.startswith("# ")} == {MARK}


def test_editors_and_type_checkers_see_the_names(tmp_path: Path) -> None:
    """From the stubs alone: what stands in other modules would take a minute."""
    for path in STUBS:
        copy = tmp_path / path.relative_to(ROOT)
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_bytes(path.read_bytes())
    (tmp_path / "code.py").write_text(
        "import ep2sindy as ep\n"
        "from ep2sindy.prepare import crop\n"
        "from ep2sindy.discovery import Estimate\n"
        "ep.inspect_file, ep.thruster.Thruster, ep.warnings.SlowSearch, ep.__version__\n"
        "ep.discovre\n"
        "ep.thruster.Thrster\n"
        "ep.crop\n"
    )
    result = subprocess.run(
        [sys.executable, "-m", "mypy", "--no-site-packages", "--ignore-missing-imports", "code.py"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    errors = [line for line in result.stdout.splitlines() if ": error: " in line]
    assert [line.split('"')[1] for line in errors] == ["discovre", "Thrster", "crop"], result.stdout


@pytest.mark.parametrize(
    ("room", "name", "said"),
    [
        (
            "ep2sindy",
            "Eebic",
            r"no attribute 'Eebic'; see dir\(ep2sindy\); near it (is|are) ep2sindy.EBIC",
        ),
        ("ep2sindy", "Trajectry", r"see dir\(ep2sindy\); near it (is|are) ep2sindy.Trajectory"),
        ("ep2sindy.thruster", "crop", r"see dir\(ep2sindy.thruster\); near it is .*prepare.crop$"),
        ("ep2sindy", "_nothing", r"no attribute '_nothing'; see dir\(ep2sindy\)$"),
    ],
)
def test_an_unknown_name_says_where_to_look(room: str, name: str, said: str) -> None:
    with pytest.raises(AttributeError, match=said):
        getattr(import_module(room), name)


def test_every_old_name_is_found_or_says_what_to_use() -> None:
    old = (ROOT / "tests" / "data" / "names_0_2.txt").read_text().split()
    assert len(old) == N_OLD
    for name in old:
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            if name in read_stub(PACKAGE):
                getattr(ep, name)
                assert not said, name
            elif gone_text(f"ep2sindy.{name}"):
                with pytest.raises(AttributeError, match=f"ep2sindy.{name} is gone; "):
                    getattr(ep, name)
            else:
                new = f"ep2sindy.{RENAMED[name]}"
                assert getattr(ep, name) is dotted_names()[new].load()
                assert [each.category for each in said] == [FutureWarning]
                assert str(said[0].message).startswith(f"ep2sindy.{name} is now {new}")
                assert said[0].filename == __file__


def test_an_old_import_of_a_name_that_is_gone_says_what_to_use() -> None:
    """Python replaces the text of the error by its own, so the way out comes as a warning."""
    said = pytest.warns(FutureWarning, match=r"BIC is gone; write ep2sindy\.EBIC\(gamma=0\.0")
    with said, pytest.raises(ImportError, match="cannot import name 'BIC'"):
        exec("from ep2sindy import BIC")


CALLS = [
    (old, call)
    for old, text in {**NOTES, **GONE}.items()
    for call in re.findall(r"[\w.]+\([^()]*\)", text)
    if not call.startswith(("front.", "law.", "model_at(", "pysindy."))  # these are not the face's
]


@pytest.mark.parametrize(("old", "call"), CALLS)
def test_a_call_that_replaces_an_old_one_can_be_made(old: str, call: str) -> None:
    tree = ast.parse(call, mode="eval").body
    assert isinstance(tree, ast.Call), old
    entries = {place.rpartition(".")[2]: entry for place, entry in dotted_names().items()}
    parts = ast.unparse(tree.func).split(".")
    name, *methods = [p for p in parts if p != PACKAGE and f"{PACKAGE}.{p}" not in rooms()]
    target = reduce(getattr, methods, entries[name].load())
    keywords = {str(each.arg): None for each in tree.keywords}
    inspect.signature(target).bind_partial(*tree.args, **keywords)


def test_a_config_with_an_old_name_is_built_with_one_warning() -> None:
    config = OmegaConf.create({"prepare": [{"_target_": "ep2sindy." + "crop", "start_s": 0.0}]})
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("default")
        check_targets(config)
        assert bind_step(config.prepare[0], "prepare[0]").func is ep.prepare.crop
    (text,) = {str(each.message) for each in said if each.category is FutureWarning}
    assert text.startswith("prepare[0]: ep2sindy.crop is now ep2sindy.prepare.crop")
    assert len({each.lineno for each in said}) == 1


def test_a_name_that_is_gone_says_what_to_use(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(GONE, "OldScore", "take ep2sindy.EBIC()")
    said = r"ep2sindy\.OldScore is gone; take ep2sindy\.EBIC\(\)"
    with pytest.warns(FutureWarning, match=said), pytest.raises(AttributeError, match=said):
        ep.OldScore  # noqa: B018
    with pytest.raises(ValueError, match=f"here must name a _target_ .*{said}$"):
        target_of(OmegaConf.create({"_target_": "ep2sindy.OldScore"}), "here")


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
    found = {name for path in paths for name in targets(yaml.safe_load(path.read_text()))}
    assert found
    assert found <= FOR_CONFIGS


def test_torch_and_pandas_are_loaded_by_those_alone_who_use_them() -> None:
    code = (
        "import sys, ep2sindy as ep\n"
        "ep.discover, ep.EBIC, ep.SparseModel, ep.refinement, ep.thruster\n"
        "assert not {'torch', 'pandas', 'xarray', 'matplotlib', 'hydra'} & set(sys.modules)\n"
        "sys.modules['torch'] = None  # whoever asks for it now is told that there is none\n"
        "try:\n"
        "    ep.refine\n"
        "except ImportError as e:\n"
        "    assert e.name == 'torch', e\n"
        "else:\n"
        "    raise AssertionError('ep.refine does not load torch')\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
