"""Mistakes on the command line end in our words, with the nearest name."""

from pathlib import Path

import pytest

from ep2sindy.app.arguments import mend, options_first
from ep2sindy.app.runner import study_class
from ep2sindy.app.schema import study_of
from tests.programs import composed, ended


@pytest.mark.parametrize(
    ("typed", "message"),
    [
        (["+exp=breathin"], "unknown experiment 'breathin' (did you mean +exp=breathing?); choose"),
        (["+ex=breathing"], "an experiment is chosen with +exp=breathing, got '+ex=breathing'"),
        (["inspct", "run.csv"], "got 'inspct' (did you mean the command inspect, which stands fi"),
        (["+exp=discover", "exclude={x: [x(2]}"], "must stand in double quotes inside single ones"),
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
    assert mend("data.units={n_i:cm^-3}") == 'data.units={n_i:"cm^-3"}'
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
