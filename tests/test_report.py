"""What a study reports: in its folder, on the terminal, the page and in TensorBoard."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from omegaconf import DictConfig, OmegaConf
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import ep2sindy as ep
from ep2sindy.app.runner import start_run
from ep2sindy.report.about import settings_used
from ep2sindy.report.document import Equation, Picture, Result, Section, Table, Text
from ep2sindy.report.page import page_html, powers_html
from ep2sindy.report.picture import draw
from ep2sindy.report.report import Report
from ep2sindy.report.results import Metric, ResultTable, View
from tests.programs import summary_of

ROWS = pd.DataFrame({"n_terms": [1, 2], "r2": [0.5, float("nan")], "text": ["a < b", "[c]"]})
SECTIONS = [
    Section(
        "Fronts & models",
        [
            Text("short"),
            Text("long", page_only=True),
            Text("amiss", warning=True),
            Equation("n_i", {"n_i": -2.0}, lead="thesis", on_screen=True),
            Equation("n_n", {"n_n": 3.0}),
            Table(ROWS, title="candidates", bold=[1], italic=[0], note="a note"),
            Picture("front"),
            Picture("absent"),
        ],
    ),
    Section("Only a picture", [Picture("front")], level=3),
]
PIXEL = b"any bytes: a page embeds what it is given"
FIGURES = {"front": draw(Figure(figsize=(4.0, 3.0)), PIXEL, "Error against size <&>.")}


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


@pytest.mark.parametrize("width", [50, 80, WIDTH])
def test_marks_and_terms_stay_whole_at_any_width(width: int) -> None:
    """Piped, and in run.log, a row has no colour: the mark alone says what is selected."""
    equation = "n_i' = -1.77e+18 n_i R_ion + 7.79e-34 n_i n_n^2 - 3.45e+05 n_i  <- selected"
    table = Table(pd.DataFrame({"terms": ["2"], "R2 test": ["0.978"], "model": [equation]}))
    lines = printed(table, width).splitlines()
    assert max(map(len, lines)) <= width
    for whole in ("<- selected", "-1.77e+18 n_i R_ion", "+ 7.79e-34 n_i n_n^2", "- 3.45e+05 n_i"):
        assert sum(whole in line for line in lines) == 1


def printed(table: Table, width: int) -> str:
    console = Console(file=StringIO(), width=width, no_color=True)
    console.print(rich_table(table))
    return console.file.getvalue()  # type: ignore[attr-defined]


def test_a_page_marks_rows_and_escapes_text() -> None:
    page = page_html("a <study>", SECTIONS, FIGURES)
    assert "<h1>a &lt;study&gt;</h1>" in page
    number = '<td class="number">{}</td>'
    bold = "".join([*map(number.format, ("2", "-")), "<td>[c]</td>"])
    italic = "".join([*map(number.format, ("1", "0.5")), "<td>a &lt; b</td>"])
    assert f'<tr class="bold">{bold}</tr>' in page
    assert f'<tr class="italic">{italic}</tr>' in page
    assert "<p>long</p>" in page
    assert '<p class="warning">amiss</p>' in page
    assert '<p class="equation">thesis: <span class="math"><math' in page


@pytest.mark.parametrize(
    ("text", "html"),
    [
        ("m^-3 s^-1", "m<sup>−3</sup> s<sup>−1</sup>"),
        ("1.4232e+23 ±3e+19", "1.4232·10<sup>23</sup> ±3·10<sup>19</sup>"),
        ("x < 1e3, 2024-05-01, V1e3", "x &lt; 1·10<sup>3</sup>, 2024-05-01, V1e3"),
        ("--seed -1", "--seed -1"),
    ],
)
def test_powers_are_raised_in_all_texts(text: str, html: str) -> None:
    assert powers_html(text) == html


def test_settings_read_in_words() -> None:
    variables = {"x": {"name": "X", "unit": "1"}, "y": {"name": None, "unit": "m"}}
    settings = {
        "data": {"path": "a.csv", "variables": variables, "channel_m": None},
        "trajectory": {"_target_": "ep2sindy.data.ZoneAverage", "states": ["x"]},
        "rollout_s": 4.0e-3,
        "other": 3,
    }
    assert settings_used(settings, set(settings) - {"other"}) == {
        "data": "path a.csv, variables (x (name X, unit 1))",
        "time series": "ZoneAverage (states x)",
        "rollout s": "0.004",
    }


def test_a_page_shows_the_figures_there_are() -> None:
    page = page_html("a study", SECTIONS, FIGURES)
    assert page.count('src="data:image/png;base64,') == 2
    assert "--width: 384px" in page  # four inches
    assert "Error against size &lt;&amp;&gt;." in page
    assert "absent" not in page


MODEL = ep.lotka_volterra().model
SIZES = ResultTable({"one": 2.5, "two": 0.5}, [Metric("size", float, View.ALL, format="{:.1f} m")])
FOUND = Result("Found: a model", [Text("it is right")], 'ep.read("{}")', picture="line")


@pytest.fixture
def toy(tmp_path: Path) -> DictConfig:
    return OmegaConf.create({"experiment": "toy", "seed": 3, "output": str(tmp_path)})


def line() -> Figure:
    figure = Figure(figsize=(3.0, 2.0))
    figure.subplots().plot(np.arange(3))
    return figure


def test_a_report_that_is_finished_is_whole(toy: DictConfig) -> None:
    with start_run(toy) as report:
        report.found(FOUND)
        report.model("mine", MODEL)
        report.section("How large")
        report.table("sizes", SIZES, heading="name")
        report.table("rows", ROWS, shown=False)
        report.add(Table(ROWS.iloc[:0], title="nothing"))
        report.figure("line", line, "A line.")
        report.warn("amiss")
        report.when_written(lambda: report.write("end.txt", Path.touch))
        report.finish(purpose="To try.")
    folder, summary = report.folder.path, summary_of(report.folder.path)
    assert [section.title for section in report.sections] == ["Results", "How large"]
    assert (summary["seed"], summary["warnings"]) == (3, ["amiss"])
    assert summary["models"]["mine"]["equations"]["x"] == MODEL.terms("x")
    assert summary["sizes"] == {"one": {"size": 2.5}, "two": {"size": 0.5}}
    assert summary["rows"][1] == {"n_terms": 2, "r2": None, "text": "[c]"}
    assert summary["headline"] == {"one/size": 2.5, "two/size": 0.5}
    coefficients = pd.read_csv(folder / "tables" / "coefficients.csv")
    assert coefficients["term"].tolist() == ["x", "x*y", "y", "x*y"]
    assert (folder / "figures" / "line.png").is_file()
    assert (folder / "end.txt").is_file()
    page = (folder / "report.html").read_text()
    place = [page.index(each) for each in ("it is right", "To try.", "amiss", "How large", "2.5 m")]
    assert place == sorted(place)
    assert page.count("A line.") == 1  # in the result alone
    assert "nothing" not in page
    events = EventAccumulator(str(folder / "tensorboard")).Reload()
    assert events.Scalars("one/size")[0].value == 2.5
    assert "line" in events.Tags()["images"]


def half_a_study(config: DictConfig) -> None:
    with start_run(config) as report:
        report.model("mine", MODEL)
        report.table("sizes", SIZES, heading="name")
        report.figure("line", line, "Never drawn.")
        raise RuntimeError("halfway")


def test_what_was_written_outlives_a_later_error(toy: DictConfig) -> None:
    with pytest.raises(RuntimeError):
        half_a_study(toy)
    (folder,) = Path(toy.output, "toy").iterdir()
    assert ep.SparseModel.load(folder / "models" / "mine.json").text() == MODEL.text()
    assert pd.read_csv(folder / "tables" / "sizes.csv")["size"].tolist() == [2.5, 0.5]
    assert "ended early: RuntimeError: halfway" in (folder / "run.log").read_text()
    assert not {"summary.json", "report.html", "figures"} & {path.name for path in folder.iterdir()}


def test_two_of_one_name_are_an_error(toy: DictConfig) -> None:
    with start_run(toy) as report:
        report.table("a", ROWS)
        with pytest.raises(ValueError, match="a name of its own, got 'a' twice"):
            report.table("a", SIZES)
        assert report.tables["a"] is ROWS
