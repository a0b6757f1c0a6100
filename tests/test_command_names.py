"""Names of files, folders and columns with any signs, as they are typed and as they are printed."""

import shlex
from pathlib import Path

import numpy as np
import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from ep2sindy.app.arguments import mend
from tests.programs import ended

NAMES = [
    "dä.csv", "run(1).csv", "a b.csv", "日本.csv", "it's.csv", 'q"q.csv', "x=1.csv", "a&b.csv",
    "$HOME.csv", "a;b.csv", "[1].csv", "{z}.csv", "~t.csv", "#1.csv", "100%.csv", "-dash.csv",
    "é.dat", "run+1.csv", "a:b.csv", "back\\slash.csv", "plain.csv", "up/../plain.csv",
]  # fmt: skip


def value_of(text: str) -> object:
    (found,) = OverridesParser.create().parse_overrides([mend(text)])
    return found.value()


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("key", ["data.path", "output", "signal"])
def test_names_need_no_quotes_when_typed(key: str, name: str) -> None:
    assert value_of(f"{key}={name}") == name


@pytest.mark.usefixtures("here")
def test_a_comma_parts_jobs_of_a_sweep_unless_it_stands_in_a_name() -> None:
    (found,) = OverridesParser.create().parse_overrides([mend("data.path=a.csv,b.csv")])
    assert found.is_sweep_override()
    Path("a,b.csv").touch()
    assert value_of("data.path=a,b.csv") == "a,b.csv"


@pytest.mark.usefixtures("here")
def test_what_inspect_prints_is_pasted_into_a_shell_and_runs(
    capsys: pytest.CaptureFixture[str],
) -> None:
    name = "it's (1) ä$a&b;日本.csv"
    t = 1e-6 * np.arange(300)
    rows = np.column_stack([t, 2.0 + np.sin(1e5 * t), 2.0 + np.cos(1e5 * t)])
    np.savetxt(name, rows, delimiter=",", header="t_s,Düse_ä,b", comments="")
    assert not ended("inspect", name)
    shown = capsys.readouterr().out.splitlines()
    (line,) = (each.strip() for each in shown if "+exp=discover data" in each)
    printed = shlex.split(line)[1:]
    assert not ended(*printed, "forecasts=0", "output=Ergebnisse_für")
    assert "Düse_ä' = " in capsys.readouterr().out
