"""Names from configs are neither paths nor markup."""

from collections.abc import Mapping
from dataclasses import dataclass
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from omegaconf import OmegaConf
from programs import composed

import ep2sindy as ep
from ep2sindy.app.runner import run_config, start_run
from ep2sindy.app.schema import value_of
from ep2sindy.report.document import Equation, Link, Picture, Section, Table, Text
from ep2sindy.report.page import About, draw, page_html
from ep2sindy.report.screen import Screen

PATHS = ["../../x", "/tmp/x", "a/b", "a\\b", "..", ".", "", "~x", "a\nb", "a\0b", "x" * 300]
MARKUP = [
    "<script>alert(1)</script>", "<img src=x onerror=alert(1)>", '"onload="alert(1)', "'", "a&b",
    "[/red]", ":fire:", "$x_{$", "{{x}}",
]  # fmt: skip
MATH = {"mi", "mn", "mo", "mrow", "mspace", "msub", "msup"}  # as many as a name has signs


@dataclass(frozen=True)
class Inner:
    width: float


@pytest.mark.parametrize("name", [*PATHS, *MARKUP])
def test_what_a_config_names_is_called_by_words(name: str) -> None:
    with pytest.raises(ValueError, match="models must be named by words, for files are named so"):
        value_of(Mapping[str, Inner], {name: {"width": 1.0}}, "models")


@pytest.mark.parametrize("name", [*PATHS, *MARKUP, "1x", "a b"])
def test_variables_are_words(name: str, tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", x=np.arange(5.0))
    with pytest.raises(ValueError, match="a variable's name must be a word"):
        ep.open_field(tmp_path / "a.npz", variables={name: ep.data.Variable("x", "1")}, dt_s=1.0)


@pytest.mark.parametrize("name", ["../../x", "/tmp/x", "a/b", "a\\b", "a\nb"])
def test_a_run_writes_nowhere_but_in_its_folder(name: str, tmp_path: Path) -> None:
    config = OmegaConf.create({"experiment": "toy", "seed": 0, "output": str(tmp_path)})
    with start_run(config) as report:
        before = sorted(tmp_path.rglob("*"))
        for write in (
            lambda: report.model(name, ep.lorenz().model),
            lambda: report.table(name, pd.DataFrame()),
            lambda: report.write(name, Path.touch),
            lambda: report.folder.write_figure(name, Figure()),
        ):
            with pytest.raises(ValueError, match="must be that of a file, and no path"):
                write()
        assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("name", ["../../x", "<b>x</b>"])
def test_an_experiment_refuses_such_names_before_it_makes_a_folder(
    name: str, tmp_path: Path
) -> None:
    config = composed("+exp=breathing", f"output={tmp_path}")
    config.experiment = name
    with pytest.raises(ValueError, match="experiment must be a name for a folder"):
        run_config(config)
    assert not list(tmp_path.iterdir())


class Parsed(HTMLParser):
    """All elements of a page but the signs of formulas, with their attributes; and its text."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.text = ""
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in MATH:
            self.tags += [tag, *(name for name, _ in attrs)]

    def handle_data(self, data: str) -> None:
        self.text += data


@pytest.mark.parametrize("text", MARKUP)
def test_page_and_screen_show_markup_as_it_is(text: str, tmp_path: Path) -> None:
    def page(text: str) -> str:
        equation = Equation(text, {text: 1.0, f"{text}*y": 2.0}, lead=text, mark=text, unit=text)
        table = pd.DataFrame({text: [text, Link(text, text), equation]})
        blocks = [
            Text(text), Text(text, warning=True), Table(table, title=text, note=text), equation,
            Picture("a"),
        ]  # fmt: skip
        provenance = {"commit": text, "seed": text, "command": [text], "versions": {text: text}}
        about = About(text, {text: text}, [text], [text], provenance, text)
        figures = {"a": draw(Figure(), b"", text)}
        sections = [Section(text, blocks)]
        screen = Screen(tmp_path / "run.log")
        screen.show(sections)
        screen.close()
        return page_html(text, sections, figures, about)

    found = Parsed(page(text))
    assert text in (tmp_path / "run.log").read_text()
    assert found.text.count(text) >= 19
    assert found.tags == Parsed(page("w" * len(text))).tags
