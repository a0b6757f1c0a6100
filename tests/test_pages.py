"""The page of every experiment, in a browser: the result first, whole in itself, at two widths."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from ep2sindy.app.runner import run_config
from tests import (
    test_experiment_benchmark,
    test_experiment_fits,
    test_experiment_libraries,
    test_experiment_parametric,
    test_experiment_pointwise,
    test_experiment_predict,
    test_experiment_simulate,
    test_experiment_trace,
    test_several_zones,
)
from tests.browser import browser, seen
from tests.programs import EXPERIMENTS, composed

pytestmark = pytest.mark.slow

SCREEN_PX = 900
MOST_BYTES = 2_000_000
QUESTIONS = {
    "ends": "document.querySelector('#found').getBoundingClientRect().bottom + scrollY",
    "heading": "document.querySelector('#found h2').textContent",
    "math": "[...document.fonts].filter(f => f.status == 'loaded').map(f => f.family).join()",
    "equations": "document.querySelectorAll('math').length",
}

Toy = Callable[[Path, Path], list[str]]  # of a file of predator and prey, and an empty folder


def discover(path: Path, output: Path) -> list[str]:
    return [
        "data=file", f"data.path={path}", f"output={output}",
        "trajectory.states=[n_i,n_n]", "trajectory.zone.z=channel",
    ]  # fmt: skip


def benchmark(name: str, _: Path, output: Path) -> list[str]:
    return test_experiment_benchmark.toy(name, output)


def trace(path: Path, output: Path) -> list[str]:
    record = output / "scope.csv"
    return test_experiment_trace.toy(
        test_experiment_trace.scope(record, *test_experiment_trace.signal(24.0)), output
    )


TOYS: dict[str, Toy] = {
    **{name: partial(benchmark, name) for name in test_experiment_benchmark.TOYS},
    "breathing": test_experiment_libraries.breathing,
    "constrained": test_experiment_fits.constrained,
    "discover": discover,
    "ils": test_experiment_fits.ils,
    "parametric": lambda _, output: [
        *test_experiment_parametric.toy(output), test_experiment_parametric.POINTS,
    ],
    "pointwise": lambda path, output: [
        *test_experiment_pointwise.on_file(path, output), "data.r.name=null",
        "data.variables.u_ir.name=null",
    ],
    "predict": lambda _, output: [
        *test_experiment_predict.toy(output), test_experiment_predict.POINTS,
    ],
    "simulate": lambda _, output: test_experiment_simulate.toy(output),
    "theories": lambda _, output: test_experiment_fits.theories(output),
    "trace": trace,
    "weak": test_experiment_fits.weak,
    "zones": lambda _, output: test_several_zones.toy(output),
}  # fmt: skip


def test_every_experiment_has_a_page_here() -> None:
    assert sorted(TOYS) == EXPERIMENTS


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_a_page_shows_the_result_on_the_first_screen(
    name: str, predator_prey: Path, tmp_path: Path
) -> None:
    browser()  # skips before the run
    toy = [each for each in TOYS[name](predator_prey, tmp_path) if not each.startswith("+exp")]
    page = run_config(composed(f"+exp={name}", *toy)) / "report.html"
    assert page.stat().st_size < MOST_BYTES
    for width_px, n_screens in ((1280, 1), (390, 2)):
        found = seen(page, width_px, questions=QUESTIONS)
        assert [url for url in found.asked if not url.startswith("data:")] == [page.as_uri()]
        assert (found.console, found.empty) == ([], 0)
        assert found.scroll_px <= width_px  # what is wider scrolls in itself
        assert 2 < len(found.answers["heading"].split()) <= 12
        assert found.answers["ends"] < n_screens * SCREEN_PX, (width_px, found.answers)
        if found.answers["equations"]:
            assert "STIX Two Math in part" in found.answers["math"]
