"""From a command line to a study: configs, their errors, and sweeps."""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from omegaconf import DictConfig, OmegaConf

import ep2sindy as ep
from ep2sindy.app.runner import list_studies, run_config, study_class
from ep2sindy.app.schema import Configured, keys_of, study_of, value_of
from ep2sindy.discovery.method import AnyMethod
from ep2sindy.report.page import by_places
from ep2sindy.runtime.files import read_json
from ep2sindy.selection.criteria import Selection
from ep2sindy.studies.study import (
    Count,
    Deferred,
    Fraction,
    Levels,
    Names,
    PositiveOrAll,
    Positives,
)
from tests.programs import ended


@dataclass(frozen=True)
class Inner:
    width: float
    label: str = "none"


@dataclass(frozen=True)
class Toy:
    """A study's signature with every kind of key."""

    method: AnyMethod
    n: Count
    fraction: Fraction
    span: PositiveOrAll
    names: Names
    lengths: Positives
    noises: Levels
    inner: Inner
    many: Mapping[str, Inner]
    rows: Sequence[Inner]
    rule: Selection
    later: Deferred
    free: Mapping[str, Any] = field(default_factory=dict)
    switch: bool = False


GOOD = """
experiment: toy
seed: 0
formulation: {_target_: ep2sindy.Differential}
search: {_target_: ep2sindy.BestSubset}
bootstraps: {_target_: ep2sindy.Bootstraps, n: 0}
selection: {_target_: ep2sindy.Knee}
depth: 2
n: 3
fraction: 0.25
span: null
names: [a, b]
lengths: [10, 20]
noises: [0.0, 0.1]
inner: {width: 1}
many: {one: {width: 2.0, label: x}}
rows: [{width: 3.0}]
rule: {_target_: ep2sindy.EBIC, gamma: 0.5}
later: {_target_: ep2sindy.Knee, n_norm: library}
free: {anything: [1, {goes: here}]}
"""


def config(*changes: str) -> DictConfig:
    merged = OmegaConf.merge(OmegaConf.create(GOOD), OmegaConf.from_dotlist(list(changes)))
    assert isinstance(merged, DictConfig)
    return merged


def test_a_study_is_built_from_its_signature() -> None:
    study = study_of(Toy, config())
    assert study.method.depth == 2
    assert isinstance(study.method.search, ep.BestSubset)
    assert (study.n, study.fraction, study.span, study.switch) == (3, 0.25, None, False)
    assert (study.names, study.lengths, study.noises) == (["a", "b"], [10, 20], [0.0, 0.1])
    assert study.inner == Inner(1.0)
    assert study.many == {"one": Inner(2.0, "x")}
    assert study.rows == [Inner(3.0)]
    assert study.rule == ep.EBIC(gamma=0.5)
    assert study.later.build() == ep.Knee()
    assert study.free == {"anything": [1, {"goes": "here"}]}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("nn=1", r"unknown keys \['nn'\] \(did you mean n\?\); keys are \["),
        ("n=0", "n must be a whole number, one or more: got 0"),
        ("names=[a,a]", r"names must be a list such as \[a,b\], each once"),
        ("inner.widht=1", r"^inner, Inner: .*mean width\?\); it takes \['width', 'label'\]"),
        (
            "rows=[{width: 1, hight: 2}]",
            r"rows\[0\], Inner: got an unexpected .* 'hight'",
        ),
        ("rows=[{width: wide}]", r"rows\[0\].width must be a number: got 'wide'"),
        ("search.max_terms=???", r"^search.max_terms must be set, got '\?\?\?'"),
        ("many.one=null", r"many.one must have \['width', 'label'\]: got None"),
        ("selection._target_=ep2sindy.BestSubset", "selection must name a _target_ that is a Sele"),
    ],
)
def test_a_setting_that_cannot_be_is_refused_by_its_place(change: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        study_of(Toy, config(change))


@pytest.mark.parametrize("key", ["fraction", "search"])
def test_a_key_that_is_missing_is_named_and_a_group_does_not_become_another(key: str) -> None:
    without = config()
    del without[key]
    with pytest.raises(ValueError, match=f"must have '{key}'"):
        study_of(Toy, without)


def test_what_is_built_later_can_be_changed_by_place() -> None:
    point = {"voltage": 300.0, "mass_flow_mg_s": 5.0}
    node = {"_target_": "ep2sindy.thruster.OperatingPoint", **point}
    later = Configured(node, "data")
    changed = later.changed({"voltage": 200.0}, {"neutral_speed": 190.0})
    assert changed.build().voltage == 200.0
    assert changed.build().neutral_speed == 190.0
    assert later.build().voltage == 300.0
    assert str(changed) != str(later)
    with pytest.raises(ValueError, match="data.volts must be there to be changed: it is not"):
        later.changed({"volts": 1.0})


def test_studies_are_found_by_name() -> None:
    assert "libraries" in list_studies()
    assert study_class("libraries").__name__ == "Study"
    for name in ("librarys", "ep2sindy.studies.views"):
        with pytest.raises(ValueError, match=f"study must name a module .* '{name}'"):
            study_class(name)


def test_runs_are_compared_by_plain_settings() -> None:
    settings: Any = OmegaConf.to_container(config(), resolve=True)
    found = by_places(settings, keys_of(Toy))
    assert found["n"] == 3
    assert found["names"] == "a, b"
    assert found["search"] == "BestSubset"
    assert (found["rule"], found["rule.gamma"]) == ("EBIC", 0.5)
    assert found["many.one.width"] == 2.0
    assert "span" not in found  # it is not set


@pytest.mark.parametrize("value", [True, -1, "a"])
def test_a_seed_must_be_a_number(value: object) -> None:
    with pytest.raises(ValueError, match="seed must be a whole number, zero or more"):
        run_config(OmegaConf.create({"seed": value, "experiment": "toy", "study": "libraries"}))


def test_a_value_of_two_kinds_is_taken_as_the_first_that_fits() -> None:
    assert value_of(int | str, 3, "x") == 3
    assert value_of(int | str, "a", "x") == "a"
    assert value_of(float | None, None, "x") is None
    later = {"_target_": "ep2sindy.Knee"}
    assert isinstance(value_of(Deferred | None, later, "x"), Deferred)
    assert value_of(ep.Knee | ep.EBIC, later, "x") == ep.Knee()
    with pytest.raises(ValueError, match="x must name a _target_ that is a Mapping"):
        value_of(Mapping[str, Any], later, "x")


def test_free_keys_may_name_a_target() -> None:
    """A point of a parametric study may have other data than the rest."""
    free = study_of(Toy, config("free.data={_target_: ep2sindy.open_field}")).free["data"]
    assert free == {"_target_": "ep2sindy.open_field"}


def test_interpolations_are_followed_at_any_depth() -> None:
    changes = ["names=['${experiment}',b]", "many.one=${inner}", "free.anything=['${n}']"]
    study = study_of(Toy, config(*changes))
    assert study.names == ["toy", "b"]
    assert study.many == {"one": Inner(1.0)}
    assert study.free == {"anything": [3]}


def test_a_sweep_goes_on_after_a_failed_job_and_says_so(
    here: Path, capsys: pytest.CaptureFixture
) -> None:
    """Three jobs that end early, each for its own reason: no job ends another."""
    (here / "conf" / "exp").mkdir(parents=True)
    own = "# @package _global_\ndefaults: [discover]\nexperiment: mine\n"
    (here / "conf" / "exp" / "mine.yaml").write_text(own)
    error = ended(
        "-m", "+exp=mine", "data=file", "data.path=none.nc", "trajectory.states=[x,y]", "seed=-1,2"
    )
    assert error == "error: 2 jobs failed"
    assert "Traceback" not in capsys.readouterr().err
    paths = sorted(here.glob("outputs/multirun/*/jobs/*.json"))
    errors = [read_json(path.read_text())["error"] for path in paths]
    assert errors[0] == "seed must be a whole number, zero or more: got -1"
    assert errors[1].startswith("no such file: ")


@pytest.mark.parametrize(
    ("launcher", "message"),
    [
        ("slurm", "error: the launcher must be able to run the jobs, got: Could not detect"),
        pytest.param("submitit_local", "error: 2 jobs failed", marks=pytest.mark.slow),
    ],
)
def test_a_launcher_that_fails_and_jobs_that_fail_elsewhere_are_said(
    launcher: str, message: str, here: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
) -> None:  # fmt: skip
    monkeypatch.setattr(shutil, "which", lambda *_: None)  # as on a machine without SLURM
    error = ended("-m", "+exp=weak", f"hydra/launcher={launcher}", "seed=-1,-2")
    assert error.startswith(message)
    assert ("job 1 failed: seed must be a whole" in capsys.readouterr().out) == (
        launcher != "slurm"
    )


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ([], "error: choose an experiment with +exp=NAME: benchmark, breathing"),
        (["+exp=discover", "data=file", "data.path=x"], "trajectory.states must be set, got"),
        (["+exp=breathing", "output=/proc/none"], "choose another with output=PATH"),
    ],
)
def test_mistakes_end_in_one_clear_message(overrides: list[str], message: str, here: Path) -> None:
    error = ended(*overrides)
    assert message in error
    assert error.startswith("error: ")
    assert not list(here.glob("outputs/*/*"))  # no run folder of a run that never began
