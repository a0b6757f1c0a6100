"""A config may come from anybody: it runs nothing, and writes nothing where nobody said so."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.utils import create_config_search_path
from hydra.core.config_search_path import SearchPathQuery
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from test_face import targets

from ep2sindy._stubs import dotted_names
from ep2sindy.app import safety
from ep2sindy.app.runner import run_config, study_class
from ep2sindy.app.safety import CheckedLoader, check_places, check_references, resolved
from ep2sindy.app.schema import as_node, bind, defaults_of
from ep2sindy.app.targets import FOR_CONFIGS, check_targets
from ep2sindy.studies.libraries import register_named
from tests.programs import ended

ROOT = Path(__file__).resolve().parents[1]
RUNS = "__import__('pathlib').Path('canary_that_sang').touch()"
BOMB = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]\n" for k in range(1, 12)
)
# What Hydra would call, what writes or runs what it is given, and what is not for configs.
REFUSED = [
    "sympy.sympify", "joblib.load", "pandas.read_pickle", "numpy.load", "pathlib.Path.write_text",
    "os.system", "subprocess.run", "builtins.eval", "builtins.exec", "builtins.dict", "torch.load",
    "functools.partial", "importlib.import_module", "hydra.utils.instantiate", "shutil.rmtree",
    "ep2sindy.write_field", "ep2sindy.SparseModel.load", "ep2sindy.SparseModel",
    "ep2sindy.discover", "ep2sindy.register_function", "ep2sindy.for_configs",
    "ep2sindy.runtime.files.write_text", "ep2sindy.app.schema.bind",
    "ep2sindy.studies.libraries._register_one", "ep2sindy.EBIC.scores", "ep2sindy.EBIC.__init__",
    "ep2sindy._stubs.dotted_names", "ep2sindy.warnings", "ep2sindy.thruster.zone_balance",
    "ep2sindy.thruster.parameters.Thruster", "ep2sindy.prepare.import_module", "crop",
    "ep2sindy.ep2sindy.crop", "ep2sindy.thruster.crop", "ep2sindy.model.r2", "prepare.crop",
    "ep2sindy", "EBIC", "", "..EBIC", "../EBIC", "ep2sindy..EBIC", None, 1,
]  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_only_what_is_for_configs_is_built(name: object) -> None:
    node = OmegaConf.create({"_target_": name})
    with pytest.raises(ValueError, match=r"here must name a _target_ .*came"):
        bind(node, "here")
    inner = OmegaConf.create({"_target_": "ep2sindy.Weak", "windows": {"_target_": name}})
    with pytest.raises(ValueError, match=r"here\.windows must name a _target_ .*came"):
        bind(inner, "here")
    with pytest.raises(ValueError, match=r"a\.b\[0\] must name a _target_ .*came"):
        check_targets(OmegaConf.create({"a": {"b": [{"_target_": name}]}}))


def test_a_config_is_refused_before_anything_of_it_is_built(tmp_path: Path) -> None:
    evil = {"_target_": "sympy.sympify", "a": RUNS}
    common = {"seed": 0, "experiment": "toy", "study": "libraries", "output": str(tmp_path)}
    with pytest.raises(ValueError, match=r"x\[0\] must name a _target_ .*'sympy.sympify' came"):
        run_config(OmegaConf.create({**common, "x": [evil]}))
    assert not list(tmp_path.iterdir())


def test_keys_of_hydra_in_a_node_do_nothing_but_are_refused() -> None:
    for key, value in (("_args_", [1]), ("_partial_", True), ("_recursive_", False)):
        node = OmegaConf.create({"_target_": "ep2sindy.EBIC", key: value})
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
    assert bind(OmegaConf.create({"_target_": "my_steps.half"}), "prepare[0]", None)(4.0) == 2.0
    for name in ("wipe", "os.system", "os", "nothing"):
        with pytest.raises(ValueError, match=f"'my_steps.{name}' came"):
            bind(OmegaConf.create({"_target_": f"my_steps.{name}", "folder": "/"}), "here")
    with pytest.raises(ValueError, match=r"mark it with @ep\.for_configs where it is defined"):
        bind(OmegaConf.create({"_target_": "my_steps.wipe", "folder": "/"}), "here")
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
            register_named([f"{name}.tanh(x)"])
    assert not {"idlelib", "this"} & (set(sys.modules) - before)


CALLBACK = {"_target_": "sympy.sympify", "_args_": [RUNS]}
ELSEWHERE = [
    ({"hydra": {"callbacks": {"x": CALLBACK}}}, "hydra.callbacks must stay as it is"),
    ({"hydra": {"job_logging": {"filters": {"f": {"()": "os.abort"}}}}}, "job_logging must stay"),
    ({"hydra": {"run": {"dir": "../elsewhere"}}}, "must not set hydra.run.dir"),
    ({"hydra": {"output_subdir": "elsewhere"}}, "must not set hydra.output_subdir"),
    ({"hydra": {"job": {"env_set": {"PATH": "."}}}}, "must not set hydra.job.env_set.PATH"),
    ({"hydra": {"launcher": {"_target_": "os.abort"}}}, "must not set hydra.launcher._target_"),
    ({"hydra": {"sweeper": {"params": {"seed": "0,1"}}}}, "must not set hydra.sweeper.params.seed"),
    ({"hydra": {"mode": "MULTIRUN"}}, "must not set hydra.mode"),
    ({"hydra": {"overrides": {"hydra": ["output=/x"]}}}, "must not set hydra.overrides.hydra"),
    ({"hydra": {"overrides": {"task": ["output=/x"]}}}, "must not set hydra.overrides.task"),
    ({"scan": {"cache": ["/elsewhere"]}}, "scan.cache to a folder below"),
    ({"output": "a\0b"}, "output to a folder below"),
    ({"output": {"a": "../elsewhere"}}, "output must be a folder's name"),  # its text has a ..
    ({"output": "../elsewhere"}, "output to a folder below the one that you start in"),
    ({"output": "${oc.env:PATH}"}, "output to a folder below"),
    ({"data": {"cache": "/elsewhere"}}, "data.cache to a folder below"),
    (
        {"parallel": {"_target_": "ep2sindy.parallel.Dask", "address": "tcp://a:1"}},
        "parallel.address, for",
    ),
]


@pytest.mark.parametrize(("said", "message"), ELSEWHERE, ids=lambda v: v if type(v) is str else "")
def test_a_file_cannot_say_what_must_be_typed(
    said: dict[str, Any], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Through Hydra's own door, in this process: what it would do with the config comes later."""
    text = "# @package _global_\ndefaults: [_self_]\n" + OmegaConf.to_yaml(said)
    monkeypatch.chdir(tmp_path)
    modes = (RunMode.RUN, RunMode.MULTIRUN) if "hydra" in said else (RunMode.RUN,)
    for mode in modes:
        with pytest.raises(ValueError, match=message):
            # As Hydra's loader does, and then a job before all else.
            check_places(resolved(loaded(tmp_path, text, mode)), ["+exp=theirs"])


def test_a_file_may_say_what_need_not_be_typed(tmp_path: Path) -> None:
    text = "# @package _global_\ndefaults: [discover, _self_]\nseed: 3\n"
    assert loaded(tmp_path, text).seed == 3


def loaded(folder: Path, text: str, mode: RunMode = RunMode.RUN) -> DictConfig:
    """The config of an experiment that somebody wrote into a folder."""
    (folder / "exp").mkdir(exist_ok=True)
    (folder / "exp" / "theirs.yaml").write_text(text)
    return loader_of(folder).load_configuration("config", ["+exp=theirs"], mode)


def test_what_is_typed_is_composed_once_for_all_jobs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    composed: list[list[str]] = []
    whole = ConfigLoaderImpl.load_configuration

    def counted(loader: ConfigLoaderImpl, name: str, overrides: list[str], *how: Any, **more: Any):
        composed.append(overrides)
        return whole(loader, name, overrides, *how, **more)

    monkeypatch.setattr(ConfigLoaderImpl, "load_configuration", counted)
    loader = loader_of(tmp_path)
    for seed in range(3):
        loader.load_configuration("config", [f"seed={seed}", "hydra.mode=RUN"], RunMode.RUN)
    mode = loader.load_configuration("config", ["seed=4"], RunMode.MULTIRUN, True, False)
    assert mode.hydra.mode is None
    assert len(composed) == 4
    assert composed.count(["hydra.mode=RUN"]) == 1


def loader_of(folder: Path) -> CheckedLoader:
    """As the program has it with the configs of a folder."""
    path = create_config_search_path(str(ROOT / "conf"))
    path.prepend("command-line", f"file://{folder}", SearchPathQuery(provider="schema"))
    return CheckedLoader(path)


@pytest.mark.filterwarnings(r"ignore:\s*'hydra/sweeper/basic' is validated")
def test_a_folder_cannot_hide_what_hydra_itself_says(tmp_path: Path) -> None:
    """A file of the name of Hydra's own sweeper would add to what is typed."""
    file = tmp_path / "hydra" / "sweeper" / "basic.yaml"
    file.parent.mkdir(parents=True)
    kind = "hydra._internal.core_plugins.basic_sweeper.BasicSweeper"
    file.write_text(f"_target_: {kind}\nmax_batch_size: null\nparams: {{output: ../elsewhere}}\n")
    for mode in (RunMode.RUN, RunMode.MULTIRUN):
        with pytest.raises(ValueError, match=r"must not set hydra\.sweeper\.params"):
            loader_of(tmp_path).load_configuration("config", ["+exp=discover"], mode)


TOO_MUCH = [
    (BOMB, r"may hold up to 100000 values: with its anchors written out it has"),
    ("a: &a {b: *a}", "may hold up to 100000 values"),
    ("a: " + "[" * 3000 + "]" * 3000, "must not be nested"),
    ("seed: 1" + "0" * 5000, "Exceeds the limit"),
    ("null: 2", "Incompatible key type"),
]


@pytest.mark.parametrize(("text", "message"), TOO_MUCH, ids=lambda v: v[:9])
def test_a_file_that_asks_for_too_much_is_refused_by_name(
    text: str, message: str, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=rf"theirs\.yaml.* {message}"):
        loaded(tmp_path, text)


DOUBLED = {
    "text": "x0: 0123456789\n"
    + "".join(f"x{k}: ${{x{k - 1}}}${{x{k - 1}}}\n" for k in range(1, 40)),
    "lists": "x0: [1]\n"
    + "".join(f"x{k}: ['${{x{k - 1}}}', '${{x{k - 1}}}']\n" for k in range(1, 40)),
    "places": "x: [aaaa, " + ", ".join(f"'${{x.{k}}}${{x[{k}]}}'" for k in range(40)) + "]",
    "groups": "".join(f"a-{k}: {{v: '${{a-{k + 1}.v}}${{a-{k + 1}.v}}'}}\n" for k in range(40))
    + "a-40: {v: aaaa}\n",
}


@pytest.mark.parametrize("text", DOUBLED.values(), ids=DOUBLED)
def test_references_that_double_are_refused_before_they_are_written_out(
    text: str, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match="may stand for up to"):
        loaded(tmp_path, f"# @package _global_\n{text}")


def test_a_long_list_is_no_reference(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(safety, "MAX_CHARACTERS", 1000)
    check_references({"a": [1.5] * 10_000, "b": "${a}", "c": {"d": "${b}", "e": "${.d}"}})


def test_text_that_becomes_a_group_is_looked_at_as_one(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    said = {"data": "${oc.create:'{_target_: ep2sindy.thruster.simulate, cache: ../elsewhere}'}"}
    with pytest.raises(ValueError, match=r"data\.cache to a folder below"):
        check_places(resolved(OmegaConf.create(said)), [])
    check_places(resolved(OmegaConf.create(said)), ["data.cache=../elsewhere"])


@pytest.mark.parametrize("cache", ["../elsewhere", "${place}"])
def test_what_cannot_be_resolved_yet_hides_no_folder(
    cache: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A variable of the environment may come while the package is loaded."""
    monkeypatch.chdir(tmp_path)
    said = {"place": "../elsewhere", "data": {"note": "${oc.env:NOT_YET_THERE}", "cache": cache}}
    with pytest.raises(ValueError, match=r"data\.cache to a folder below"):
        check_places(resolved(OmegaConf.create(said)), [])
    later = {"data": {"cache": "${oc.env:NOT_YET_THERE}"}}
    with pytest.raises(OmegaConfBaseException, match="NOT_YET_THERE"):
        check_places(resolved(OmegaConf.create(later)), [])


def test_what_is_typed_is_the_users_own_wish(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    elsewhere, here = tmp_path / "elsewhere", tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    ended("-m", "+exp=discover", f"output={elsewhere}", "seed=-1")
    assert "seed must be a whole number" in capsys.readouterr().out
    assert list(elsewhere.iterdir())


def test_the_program_looks_before_hydra_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the whole program, for Hydra's parts may move: neither a run nor a sweep obeys it."""
    (tmp_path / "conf" / "exp").mkdir(parents=True)
    text = "# @package _global_\ndefaults: [discover, _self_]\n" + OmegaConf.to_yaml(
        {"hydra": {"callbacks": {"x": CALLBACK}}}
    )
    (tmp_path / "conf" / "exp" / "theirs.yaml").write_text(text)
    result = subprocess.run(
        [sys.executable, "-m", "ep2sindy.app.main", "+exp=theirs"], cwd=tmp_path,
        env={"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin"}, capture_output=True, text=True,
    )  # fmt: skip
    assert result.returncode == 1
    assert "error: hydra.callbacks must stay as it is" in result.stderr
    assert "Traceback" not in result.stderr
    monkeypatch.chdir(tmp_path)
    assert "error: hydra.callbacks must stay as it is" in ended("-m", "+exp=discover,theirs")
    assert {path.name for path in tmp_path.iterdir()} <= {"conf", "outputs"}  # it has not run
    refused = ended("--config-path", str(tmp_path), "+exp=discover")
    assert "error: every run begins with the package's own config.yaml" in refused
