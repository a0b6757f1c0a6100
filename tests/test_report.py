"""What a study says, on the terminal, the page and in TensorBoard."""

from io import StringIO
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from rich.console import Console
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from ep2sindy.report.document import Captioned, Equation, Picture, Section, Table, Text
from ep2sindy.report.page import page_html
from ep2sindy.report.screen import WIDTH, Screen, rich_table
from ep2sindy.report.tensorboard import Board

ROWS = pd.DataFrame({"n_terms": [1, 2], "r2": [0.5, float("nan")], "text": ["a < b", "[c]"]})
SECTIONS = [
    Section(
        "Fronts & models",
        [
            Text("short"),
            Text("long", page_only=True),
            Text("amiss", warning=True),
            Equation("n_i", {"n_i": -2.0}, lead="thesis", aside=True, on_screen=True),
            Equation("n_n", {"n_n": 3.0}),
            Table(ROWS, title="candidates", bold=[1], italic=[0], note="a note"),
            Picture("front"),
            Picture("absent"),
        ],
    ),
    Section("Only a picture", [Picture("front")], level=3),
]
FIGURES = {"front": Captioned(Figure, "Error against size <&>.")}


@pytest.fixture
def log(tmp_path: Path) -> str:
    screen = Screen(tmp_path / "run.log")
    screen.show(SECTIONS)
    screen.close()
    return (tmp_path / "run.log").read_text()


def test_a_screen_shows_what_fits_a_screen(log: str) -> None:
    for text in ("Fronts & models", "short", "amiss", "thesis: n_i' = -2 n_i", "candidates"):
        assert text in log
    for text in ("a < b", "[c]", "a note"):  # markup of ours must not eat a user's brackets
        assert text in log
    for text in ("long", "n_n", "Only a picture", "caption"):
        assert text not in log
    assert max(map(len, log.splitlines())) <= WIDTH


def test_numbers_read_alike_on_screen_and_page(log: str) -> None:
    page = page_html("a study", SECTIONS, FIGURES)
    for cells in (("2", "-"), ("1", "0.5")):
        assert all(f"<td>{cell}</td>" in page for cell in cells)
        assert any(all(cell in line for cell in cells) for line in log.splitlines())


@pytest.mark.parametrize("width", [50, 80, WIDTH])
def test_marks_and_terms_stay_whole_at_any_width(width: int) -> None:
    """Piped, and in run.log, a row has no colour: the mark alone says what is selected."""
    equation = "n_i' = -1.77e+18 n_i R_ion + 7.79e-34 n_i n_n^2 - 3.45e+05 n_i  <- selected"
    table = Table(pd.DataFrame({"terms": ["2"], "R2 test": ["0.978"], "model": [equation]}))
    console = Console(file=StringIO(), width=width, no_color=True)
    console.print(rich_table(table))
    lines = console.file.getvalue().splitlines()  # type: ignore[attr-defined]
    assert max(map(len, lines)) <= width
    for whole in ("<- selected", "-1.77e+18 n_i R_ion", "+ 7.79e-34 n_i n_n^2", "- 3.45e+05 n_i"):
        assert sum(whole in line for line in lines) == 1


def test_text_too_long_for_a_line_breaks_between_words() -> None:
    console = Console(file=StringIO(), width=30)
    text = "note: " + "word " * 20 + "[no markup]"
    console.print(rich_table(Table(pd.DataFrame({"note": [text]}))))
    printed = console.file.getvalue()  # type: ignore[attr-defined]
    assert max(map(len, printed.splitlines())) <= 30
    assert printed.count("word") == 20
    assert "[no markup]" in printed


def test_a_page_marks_rows_and_escapes_text() -> None:
    page = page_html("a <study>", SECTIONS, FIGURES)
    assert "<h1>a &lt;study&gt;</h1>" in page
    assert '<tr class="bold"><td>2</td><td>-</td><td>[c]</td></tr>' in page
    assert '<tr class="italic"><td>1</td><td>0.5</td><td>a &lt; b</td></tr>' in page
    assert "<p>long</p>" in page
    assert '<p class="warning">amiss</p>' in page
    assert "thesis: d<i>n</i><sub>i</sub>/dt = &minus; 2 <i>n</i><sub>i</sub>" in page


def test_a_page_shows_the_figures_there_are() -> None:
    page = page_html("a study", SECTIONS, FIGURES)
    assert page.count('<img src="figures/front.png"') == 2
    assert "Error against size &lt;&amp;&gt;." in page
    assert "absent" not in page


def test_tensorboard_reads_what_a_run_tells_it(tmp_path: Path) -> None:
    png = tmp_path / "figure.png"
    figure = Figure(figsize=(3.0, 2.0))
    figure.subplots().plot(np.arange(3))
    figure.savefig(png, dpi=100)
    board = Board(tmp_path / "run" / "tensorboard")
    board.scalars({"loss": 0.5}, step=1)
    board.scalars({"loss": 0.25}, step=2)
    board.image("front", png)
    board.text("model", "x' = y\ny' = -x")
    board.settings({"seed": 3, "search": "BestSubset"}, {"r2": 0.75})
    board.close()
    events = EventAccumulator(str(tmp_path / "run" / "tensorboard")).Reload()
    assert [(e.step, e.value) for e in events.Scalars("loss")] == [(1, 0.5), (2, 0.25)]
    assert events.Scalars("r2")[0].value == 0.75
    (image,) = events.Images("front")
    assert (image.width, image.height) == (300, 200)
    assert image.encoded_image_string == png.read_bytes()
    (text,) = events.Tensors("model")
    assert b"    y' = -x" in text.tensor_proto.string_val[0]
    plugins = events.PluginTagToContent("hparams")
    assert {"_hparams_/experiment", "_hparams_/session_start_info"} <= set(plugins)
    assert b"BestSubset" in plugins["_hparams_/session_start_info"]


def test_a_board_without_a_word_leaves_no_file(tmp_path: Path) -> None:
    Board(tmp_path / "tensorboard").close()
    assert not (tmp_path / "tensorboard").exists()
