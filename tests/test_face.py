"""The face: what users import and configs name."""

import ast
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest
import yaml

import ep2sindy as ep
from ep2sindy.app.targets import FOR_CONFIGS

ROOT = Path(__file__).resolve().parents[1]


def test_every_name_of_the_face_is_where_the_table_says() -> None:
    lost = [
        f"{name} is not in {module}"
        for name, module in ep._MODULES.items()
        if getattr(ep, name) is not getattr(import_module(f"ep2sindy.{module}"), name, None)
    ]
    assert not lost, "\n".join(lost)
    assert set(ep._MODULES) <= set(dir(ep))


def test_editors_see_the_names_that_are_loaded() -> None:
    tree = ast.parse(Path(ep.__file__).read_text())
    (block,) = (n for n in tree.body if isinstance(n, ast.If))
    seen = {
        alias.asname: node.module
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert seen == {name: f"ep2sindy.{module}" for name, module in ep._MODULES.items()}


def test_an_unknown_name_says_where_to_look() -> None:
    with pytest.raises(AttributeError, match=r"no attribute 'Eebic'; see dir\(ep2sindy\)"):
        ep.Eebic  # noqa: B018


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


def test_configs_name_the_face_and_what_it_has() -> None:
    paths = [p for p in (ROOT / "conf").rglob("*.yaml") if "hydra" not in p.parts]
    found = {name for path in paths for name in targets(yaml.safe_load(path.read_text()))}
    assert found
    assert {name.removeprefix("ep2sindy.") for name in found} <= FOR_CONFIGS
    assert set(ep._MODULES) >= FOR_CONFIGS


def test_torch_and_pandas_are_loaded_by_those_alone_who_use_them() -> None:
    code = (
        "import sys, ep2sindy as ep\n"
        "ep.discover, ep.EBIC, ep.SparseModel\n"
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
