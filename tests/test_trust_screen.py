"""Texts of files on a terminal, and a terminal that goes away."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf

from ep2sindy.app.inspection import commands, config_text
from ep2sindy.data.open import inspect_file
from ep2sindy.report.screen import Screen
from ep2sindy.runtime.screen import in_line, one_screen, plain, say
from tests.test_trust_folder import CSV, write_csv

ODD = (
    "\x1b[31mred\x1b[0m",
    "${oc.env:HOME}",
    r"back\${x}",
    "ok\u202eabc",
    "I [arb]",
    "it's",
)


@pytest.fixture
def odd(tmp_path: Path) -> Path:
    """Columns whose names steer terminals, or would mean something in a config."""
    path = tmp_path / "a\n_target_: b.csv"
    t = 0.05 * np.arange(60)
    rows = np.column_stack([t, *(np.sin(t + k) for k in range(len(ODD)))])
    np.savetxt(path, rows, delimiter=",", header=",".join(["time", *ODD]), comments="")
    return path


def test_what_steers_a_terminal_is_written_out() -> None:
    assert plain("a\tb\nc\x1b[2Jd\re\u202ef\udcffg é ∂ 中") == (
        r"a	b" "\n" r"c\x1b[2Jd\re\u202ef\udcffg é ∂ 中"
    )
    assert in_line("a\tb\nc") == r"a\tb\nc"
    assert one_screen(["a\x1bb"]) == r"a\x1bb"


def test_a_config_for_odd_names_reads_back_as_they_are(odd: Path) -> None:
    """None becomes an interpolation, a line of YAML, or part of one."""
    found = inspect_file(odd)
    assert all(line.isprintable() for line in found.lines())
    config = OmegaConf.create(config_text([found], [str(odd)]))
    assert config.path == str(odd)
    assert config._target_ == "ep2sindy.open_field"
    names = {variable.name for variable in config.variables.values() if variable.name}
    assert names == {*ODD}
    assert commands([found], "mine", None)[-1].startswith("ep2sindy +exp=discover data=mine")


@pytest.mark.skipif(os.name == "nt", reason="pipes of POSIX")
def test_a_screen_that_has_gone_away_ends_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w") as gone:
        monkeypatch.setattr(sys, "stdout", gone)
        screen = Screen(tmp_path / "run.log")
        for text in ("first", "second"):
            screen.print(text)
            say(text)
        screen.close()
    assert (tmp_path / "run.log").read_text() == "first\nsecond\n"


@pytest.mark.slow
def test_a_run_whose_screen_is_lost_leaves_all_its_files(tmp_path: Path) -> None:
    write_csv(tmp_path / "run.csv")
    command = [sys.executable, "-m", "ep2sindy.app.main", *CSV]
    with open("/dev/full", "w") as full:
        subprocess.run(command, cwd=tmp_path, stdout=full, check=True)
    (folder,) = (tmp_path / "outputs" / "discover").iterdir()
    names = {path.name for path in folder.iterdir()}
    assert {"summary.json", "report.html", "figures", "models", "tables", "run.log"} <= names
    assert "run freely from one sample" in (folder / "run.log").read_text()
