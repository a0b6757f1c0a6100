"""A config may name only what is marked for configs, of the package or of one's own code."""

import sys
from pathlib import Path

import pytest
from omegaconf import OmegaConf
from test_face import targets

from ep2sindy._stubs import dotted_names
from ep2sindy.app.runner import run_config, study_class
from ep2sindy.app.schema import as_node, bind, defaults_of
from ep2sindy.app.targets import FOR_CONFIGS, check_targets
from ep2sindy.studies.libraries import registered
from tests.programs import ended

RUNS = "__import__('pathlib').Path('canary_that_sang').touch()"
# What Hydra would call, what writes or runs what it is given, and what is not for configs.
REFUSED = [
    "sympy.sympify", "os.system", "builtins.eval", "functools.partial", "hydra.utils.instantiate",
    "ep2sindy.data.write_field", "ep2sindy.SparseModel.load", "ep2sindy.runtime.files.write_text",
    "ep2sindy.EBIC.__init__", "ep2sindy.thruster.parameters.Thruster",
    "ep2sindy.data.import_module", "ep2sindy.thruster.crop", "prepare.crop", "crop", "ep2sindy",
    "..EBIC", "", None, 1,
]  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_only_what_is_for_configs_is_built(name: object) -> None:
    node = {"_target_": name}
    with pytest.raises(ValueError, match=r"here must name a _target_ .*got "):
        bind(node, "here")
    inner = {"_target_": "ep2sindy.Weak", "test_functions": {"_target_": name}}
    with pytest.raises(ValueError, match=r"here\.test_functions must name a _target_ .*got "):
        bind(inner, "here")
    with pytest.raises(ValueError, match=r"a\.b\[0\] must name a _target_ .*got "):
        check_targets({"a": {"b": [{"_target_": name}]}})


def test_a_config_is_refused_before_anything_of_it_is_built(tmp_path: Path) -> None:
    evil = {"_target_": "sympy.sympify", "a": RUNS}
    common = {"seed": 0, "experiment": "toy", "study": "libraries", "output": str(tmp_path)}
    with pytest.raises(ValueError, match=r"x\[0\] must name a _target_ .*got 'sympy.sympify'"):
        run_config(OmegaConf.create({**common, "x": [evil]}))
    assert not list(tmp_path.iterdir())


def test_keys_of_hydra_in_a_node_do_nothing_but_are_refused() -> None:
    for key, value in (("_args_", [1]), ("_partial_", True), ("_recursive_", False)):
        node = {"_target_": "ep2sindy.EBIC", key: value}
        with pytest.raises(ValueError, match=f"unexpected keyword argument '{key}'"):
            bind(node, "rule")


@pytest.mark.parametrize("name", sorted(FOR_CONFIGS))
def test_defaults_that_are_written_out_can_be_built_again(name: str) -> None:
    assert targets(as_node(defaults_of(dotted_names()[name].load()))) <= FOR_CONFIGS


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a module of the user's own."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my_steps.py").write_text(
        "import os\nimport ep2sindy as ep\n"
        "@ep.for_configs\ndef half(field):\n    return field / 2\n"
        "def wipe(folder):\n    raise AssertionError('this ran')\n"
        "class Study:\n    pass\n"
    )
    yield tmp_path
    for name in ("my_steps", "my_pack", "my_pack.study"):
        sys.modules.pop(name, None)


def test_a_function_of_ones_own_is_taken_where_it_is_marked(own: Path) -> None:
    assert bind({"_target_": "my_steps.half"}, "prepare[0]", None)(4.0) == 2.0
    for name in ("os.system", "os", "nothing"):
        with pytest.raises(ValueError, match=f"my_steps.{name}"):
            bind({"_target_": f"my_steps.{name}", "folder": "/"}, "here")
    with pytest.raises(ValueError, match=r"mark it with @ep\.for_configs where it is defined"):
        bind({"_target_": "my_steps.wipe", "folder": "/"}, "here")
    (own / "my_pack").mkdir()
    (own / "my_pack" / "study.py").write_text("class Study:\n    pass\n")
    assert study_class("my_pack.study").__module__ == "my_pack.study"


@pytest.mark.parametrize("name", ["idlelib.idle", "this.Study", "os.path", "..my_steps", "a/b.c"])
def test_studies_and_functions_are_the_packages_or_lie_in_the_folder(name: str, own: Path) -> None:
    before = set(sys.modules)
    with pytest.raises(ValueError, match="below the folder that you start in"):
        study_class(name)
    if "/" not in name and not name.startswith("."):
        with pytest.raises(ValueError, match="must lie below the folder that you start in"):
            registered(f"{name}.tanh(x)")
    assert not {"idlelib", "this"} & (set(sys.modules) - before)


def test_every_run_begins_with_the_packages_own_config(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    refused = ended("--config-path", str(tmp_path), "+exp=discover")
    assert "error: unknown option '--config-path'" in refused
