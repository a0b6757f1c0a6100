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
from ep2sindy.estimation.hidden import Coupling, with_guess
from ep2sindy.library.units import Clock
from ep2sindy.report.document import Result, Table, Text
from ep2sindy.report.results import Metric, ResultTable, View, value_text
from ep2sindy.studies.source import data_summary
from tests.programs import summary_of

ROWS = pd.DataFrame({"n_terms": [1, 2], "r2": [0.5, float("nan")], "text": ["a < b", "[c]"]})


STEPS = Clock.of("step")
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
        assert report.tables["a"].equals(ROWS)


def test_numbers_of_a_record_that_counts_samples_are_per_step(toy: DictConfig) -> None:
    run = ep.Trajectory(np.arange(8.0), np.cos(np.arange(8.0))[:, None], ["x"], clock=STEPS)
    metrics = [Metric(key, float, View.ALL) for key in ("f_kHz", "grows_per_s", "from_s")]
    with start_run(toy) as report:
        report.clock = run.clock
        report.table("runs", ResultTable({"one": 2.0}, metrics))
        report.samples("states", pd.DataFrame({"t_s": [0.0], "x_s": [1.0]}))
        report.summary |= {"data": data_summary(run), "signal": {"period_s": 7.0}}
        report.found(FOUND)
        report.finish(formats=())
    summary, own = summary_of(report.folder.path), ["f_per_step", "grows_per_step", "from_steps"]
    assert summary["runs"]["one"] == dict(zip(own, (2000.0, 2.0, 2.0), strict=True))
    assert summary["headline"]["one/f_per_step"] == 2000.0
    assert value_text("one/f_per_step", 0.14, STEPS) == "0.14 per step"
    assert list(report.tables["states"]) == ["t_steps", "x_s"]
    assert summary["signal"] == {"period_steps": 7.0}
    assert {"dt_steps", "f_per_step"} <= set(summary["data"])


@pytest.mark.parametrize(("clock", "unit"), [(STEPS, "step^-1"), (Clock.of("day"), "s^-1")])
def test_a_growth_rate_has_the_unit_of_the_times(clock: Clock, unit: str) -> None:
    t = np.arange(400.0)
    pulses = ep.Trajectory(t, np.exp(np.sin(0.3 * t))[:, None], ["x"], clock=clock)
    assert ep.embed(pulses, "rate", "x").run.units["g"] == unit
    hidden = ep.polynomial(["x", "g"], degree=2)
    way = Coupling("g", "x", "x*g", 1.0, given=True)
    assert with_guess(pulses, hidden, [way]).units["g"] == unit
    assert STEPS.rate_unit("V step^-1") == "V step^-2"
