"""Mistakes on the command line end in our words, with the nearest name."""

from pathlib import Path

import pytest

from benchmarks.regions import three_regions
from ep2sindy._stubs import read_stub
from ep2sindy.app.arguments import mend, options_first
from ep2sindy.app.runner import study_class
from ep2sindy.app.schema import bind, plain, study_of
from ep2sindy.data.fields import check_field
from tests import programs
from tests.programs import composed, ended

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.parametrize(
    ("typed", "message"),
    [
        (["+exp=breathin"], "unknown experiment 'breathin' (did you mean +exp=breathing?); choose"),
        (["+ex=breathing"], "an experiment is chosen with +exp=breathing, got '+ex=breathing'"),
        (["exp=breathing"], "'exp=breathing' adds to the config, which needs a plus: write +exp="),
        (["breathing"], "must be KEY=VALUE, such as +exp=discover or seed=1, got 'breathing'; +e"),
        (["inspct", "run.csv"], "got 'inspct' (did you mean the command inspect, which stands fi"),
        (
            ["+exp=discover", "data=recogn"],
            "mean data=recognised?); choose from file, recog",
        ),
        (
            ["+exp=discover", "serch=joint"],
            "unknown key 'serch' (did you mean search?); keys are",
        ),
        (
            ["+exp=discover", "search.alphaa=3"],
            "unknown key 'search.alphaa' (did you mean search.",
        ),
        (
            ["+exp=discover", "max_terms=3"],
            "key 'max_terms' (did you mean search.max_terms",
        ),
        (["+exp=breathing", "seed.x=3"], "unknown key 'seed.x': seed is 0, and has no keys"),
        (["+exp=discover", "data=file", "data.variables.x.name=x"], "a new one, where any is a"),
        (
            ["+exp=discover", "search=best_subset", "bootstraps=none", "bootstraps.block=3"],
            "'bootstraps.block' is left to its default here: a plus sets it, +bootstraps.block=VAL",
        ),
        (
            ["+exp=breathing", "prepare={a: b}"],
            "Cannot merge DictConfig with ListConfig; --cfg",
        ),
        (["+exp=discover", "exclude={x: [x^2]}"], "must stand in double quotes inside single ones"),
        (
            ["+exp=discover", "--confg", "job"],
            "option '--confg' (did you mean --cfg, --con",
        ),
        (["+exp=discover", "serch=joint", "sede=1"], "unknown key 'serch'; --cfg job shows those"),
    ],
)
def test_a_misspelt_name_ends_in_our_words_with_the_nearest(
    typed: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    error = ended(*typed)
    assert message in error
    assert error.startswith("error: ")
    assert "hydra.cc" not in error
    assert "Traceback" not in capsys.readouterr().err
    assert not list(tmp_path.glob("outputs/*/*/config.yaml"))


def test_names_of_a_mapping_may_come_in_quotes() -> None:
    assert mend('exclude={"x": ["x^2"], \'y\': [x]}') == 'exclude={x: ["x^2"],y: [x]}'
    assert mend("relations=['x: x == 1']") == "relations=['x: x == 1']"
    assert mend("~search") == "~search"


def test_options_may_stand_anywhere_and_keep_their_values() -> None:
    typed = ["-m", "+exp=discover", "--config-dir", "own", "seed=0,1", "--cfg=job", "~search"]
    sorted_out = options_first(typed)
    options = ["-m", "--config-dir", "own", "--cfg", "job"]
    assert sorted_out == (options, ["+exp=discover", "seed=0,1", "~search"])


def test_a_group_that_an_experiment_does_not_use_may_be_set() -> None:
    config = composed("+exp=weak", "parallel=serial")
    assert study_of(study_class(config.study), config)


# Settings with which each step of a preparation is called, on a small field.
STEPS = {
    "crop": "start_s: 1.0e-5, stop_s: 1.0e-4",
    "low_pass": "cutoff_Hz: 1.0e5, order: 2",
    "decimate": "factor: 2",
    "resample": "dt_s: 1.0e-6",
    "interpolate": "max_gap_s: 1.0e-5",
    "delay": "variable: n_i, delay_s: 1.0e-5, name: past",
    "derivative": "variable: n_i, name: rate",
    "detrend": "variables: [n_i], degree: 1",
    "gradient": 'of: "n_i*u_iz", name: slope',
    "derive": 'name: flux, expression: "n_i*u_iz", units: "m^-2/s"',
    "radial_from_middle": "middle_m: 0.04",
    "keep_where": 'condition: "(z > 0.002)"',
    "ionization_rate": "gas: xenon",
}


def test_every_step_is_called_here() -> None:
    steps = [
        name for name, entry in read_stub("ep2sindy.data").items() if entry.heading == "Preparation"
    ]
    assert set(STEPS) == {*steps, "ionization_rate"}


@pytest.mark.parametrize("name", STEPS)
def test_a_step_that_a_config_names_is_composed_and_called(name: str) -> None:
    room = "thruster" if name == "ionization_rate" else "data"
    text = f"prepare=[{{_target_: ep2sindy.{room}.{name}, {STEPS[name]}}}]"
    step = bind(plain(composed("+exp=breathing", mend(text)).prepare[0]), "prepare[0]", None)
    field = three_regions(n_z=6, n_r=5, n_samples=64).field
    if "T_e_eV" not in field:
        field = field.assign(T_e_eV=(10.0 + 0.0 * field["n_i"]).assign_attrs(units="eV"))
    if name == "ionization_rate":
        field = field.drop_vars("R_ion", errors="ignore")
    check_field(step(field))


def test_a_step_that_is_misspelt_names_the_nearest() -> None:
    config = composed("+exp=breathing", "prepare=[{_target_: ep2sindy.data.crp, start_s: 0}]")
    with pytest.raises(ValueError, match=r"near it: ep2sindy\.data\.crop"):
        programs.computed(config)
    config = composed("+exp=breathing", "prepare=[{_target_: ep2sindy.data.crop, strt_s: 0}]")
    with pytest.raises(ValueError, match=r"did you mean start_s, stop_s\?\); it takes"):
        study_of(study_class(config.study), config)
