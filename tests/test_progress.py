"""Stages of long work: who is told of them, how bars look, and that results know nothing of it."""

import fcntl
import inspect
import io
import os
import struct
import sys
import termios
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import ep2sindy as ep
from ep2sindy._stubs import dotted_names
from ep2sindy.app.runner import start_run, study_class, write
from ep2sindy.app.schema import study_of
from ep2sindy.report.document import Captioned
from ep2sindy.report.run import Run
from ep2sindy.runtime.progress import SILENT, Bars, Told, as_progress, count_pieces
from ep2sindy.selection.free_run import FreeRunScore
from ep2sindy.selection.refined import RefinedScore
from ep2sindy.studies.forecasts import skill_of
from tests import programs

LIBRARY = ep.polynomial(["x", "y"], degree=2)
BRIEF = {"duration_s": 3e-5, "warm_up_s": 3e-6}


@dataclass
class Stage:
    label: str
    unit: str
    total: int | None
    depth: int
    done: int = 0
    over: bool = False


@dataclass
class Recorder:
    """A progress that keeps every stage, in the order in which they began."""

    stages: list[Stage] = field(default_factory=list)

    @contextmanager
    def stage(self, total: int | None, unit: str, label: str = "") -> Iterator[Callable]:
        depth = sum(not each.over for each in self.stages)
        own = Stage(label, unit, total, depth)
        self.stages.append(own)

        def advance(n_more: int) -> None:
            own.done += n_more

        try:
            yield advance
        finally:
            own.over = True

    @property
    def labels(self) -> list[str]:
        return [each.label for each in self.stages]

    def of(self, unit: str) -> list[Stage]:
        return [each for each in self.stages if each.unit == unit]

    def check(self) -> None:
        """Every stage is over; one that could be counted came to its total, others somewhere."""
        for each in self.stages:
            assert each.over, each
            if each.total is not None:
                assert each.done == each.total, each
            elif each.unit:
                assert each.done > 0, each


@pytest.fixture(scope="module")
def prey() -> ep.Trajectory:
    return ep.lotka_volterra().trajectory(noise=0.01, rng=0)


def regression(selection: object = None, **settings: object) -> ep.Regression:
    return ep.Regression(
        ep.Differential(),
        ep.BestSubset(max_terms=2),
        selection or ep.EBIC(),
        ep.Bootstraps(**({"n": 4} | settings)),
    )


def test_a_regression_tells_its_stages_in_order(prey: ep.Trajectory) -> None:
    watch = Recorder()
    ep.discover(prey, LIBRARY, regression(), progress=watch)
    assert watch.labels == [
        "rows of the regression", "draws of rows", "search for x'", "search for y'",
        "candidates by EBIC",
    ]  # fmt: skip
    assert [each.total for each in watch.of("draw")] == [4, 4]
    watch.check()


def test_a_search_of_trajectories_tells_its_steps() -> None:
    watch = Recorder()
    run = ep.systems.damped_oscillator().trajectory(noise=0.01, rng=0)
    ep.discover(run, ep.polynomial(["x", "v"], degree=1), progress=watch)
    assert watch.labels[:2] == ["weighing 6 coefficients", "rivals"]
    assert [each.total for each in watch.stages[:2]] == [None, 2]
    watch.check()


@pytest.mark.parametrize(
    "rule", [FreeRunScore(n_windows=4, n_folds=2, n_confirmed=1), RefinedScore(n_windows=4)]
)
def test_rules_that_run_systems_tell_of_every_one(rule: object, prey: ep.Trajectory) -> None:
    watch = Recorder()
    coarse = replace(prey, t=prey.t[::4], states=prey.states[::4])
    found = ep.discover(coarse, LIBRARY, regression(rule, n=0), progress=watch)
    n_systems = len(found.fronts["x"].candidates) * len(found.fronts["y"].candidates)
    if isinstance(rule, RefinedScore):
        (fits,) = watch.of("fit")
        assert fits.total == 2 * 3 * (n_systems - 1)  # one of them has no term
        watch.check()
    else:
        labels = [each.label for each in watch.of("system")]
        assert labels == [*["refined without a fold"] * 2, "refined on all data"]
        assert watch.of("system")[0].done == watch.of("system")[0].total < n_systems
        assert sum(each.done for each in watch.of("run")) >= 2 * watch.of("system")[0].total
        assert all(each.over for each in watch.stages)  # the last ends with the first that lives


def test_a_result_does_not_depend_on_who_watches(prey: ep.Trajectory) -> None:
    watched, alone = (
        ep.discover(prey, LIBRARY, regression(), seed=1, **more)  # type: ignore[arg-type]
        for more in ({"progress": Recorder()}, {})
    )
    np.testing.assert_array_equal(watched.model.coef, alone.model.coef)
    np.testing.assert_array_equal(watched.model.covariance, alone.model.covariance)
    for state in ("x", "y"):
        np.testing.assert_array_equal(watched.scores[state], alone.scores[state])


def test_refinements_tell_their_iterations_and_windows(prey: ep.Trajectory) -> None:
    watch = Recorder()
    model = ep.lotka_volterra().model
    lengths = [20, 40]
    found = [
        ep.refine(model, [prey], window=length, n_windows=2, seed=0, progress=watch)
        for length in count_pieces(watch, lengths, "window length")
    ]
    outer, *inner = watch.stages
    assert (outer.unit, outer.total, outer.depth) == ("window length", 2, 0)
    assert [each.depth for each in inner] == [1, 1]
    assert [each.done for each in inner] == [len(fit.history) for fit in found]
    watch.check()


def test_a_search_of_all_points_tells_points_and_equations(prey: ep.Trajectory) -> None:
    watch = Recorder()
    points = {"a": [prey], "b": [ep.lotka_volterra().trajectory(noise=0.01, rng=1)]}
    recipe = ep.Regression(ep.Differential(), ep.BestSubset(max_terms=2))
    ep.discover_shared(points, LIBRARY, recipe, progress=watch)
    assert [(each.unit, each.total) for each in watch.stages] == [("point", 2), ("equation", 2)]
    watch.check()


@pytest.mark.parametrize("simulator", ["simulate", "simulate_2d"])
def test_a_simulator_tells_warm_up_and_record(simulator: str) -> None:
    watch = Recorder()
    if simulator == "simulate":
        point = ep.thruster.OperatingPoint(300.0, 5.0)
        field = ep.thruster.simulate(
            ep.thruster.Thruster(), point, **BRIEF, n_cells=30, progress=watch
        )
        label = point.label
    else:
        field = ep.thruster.simulate_2d(**BRIEF, n_z=24, n_r=10, progress=watch)
        label = ep.thruster.OPERATING_POINT_2D.label
    (stage,) = watch.stages
    assert (stage.label, stage.unit) == (label, "sample")
    assert stage.total == 2 + field.sizes["time"]
    watch.check()


def test_a_simulation_that_is_kept_tells_that_it_is_written(tmp_path: Path) -> None:
    run = partial(
        ep.thruster.simulate, ep.thruster.Thruster(), ep.thruster.OperatingPoint(300.0, 5.0),
        duration_s=3e-5, warm_up_s=0.0, n_cells=24, cache=tmp_path,
    )  # fmt: skip
    written, read = Recorder(), Recorder()
    run(progress=written)
    run(progress=read)
    assert written.labels[1:] == ["keeping the simulation"]
    assert read.labels == []
    written.check()


def test_forecasts_tell_their_errors_their_bands_and_every_start(prey: ep.Trajectory) -> None:
    """What comes before the first start takes longest, so it has stages of its own."""
    watch, model = Recorder(), ep.lotka_volterra().model
    told = skill_of(model, prey, n_fitted=450, starts=3, progress=watch)
    assert watch.labels == [
        "errors of the model, for forecasts", "width of the forecasts' bands", "forecasts",
    ]  # fmt: skip
    assert watch.stages[-1].total == 3
    watch.check()
    alone = ep.forecast_skill(model, prey, n_fitted=450, starts=3)
    assert told is not None
    for name, errors in alone.nrmse.items():
        np.testing.assert_array_equal(told.nrmse[name], errors)


def test_points_are_told_whoever_computes_them() -> None:
    field = grid_field()
    search = ep.discovery.PointSearch(
        ["x"], ep.named_terms(["x"], ["x", "1"]), regression(n=2, n_culled=0), seed=0
    )
    watch, numbers = Recorder(), []
    for progress in (watch, numbers.append):
        ep.pointwise(field, search, workers=ep.parallel.Serial(), block_points=2, progress=progress)
    (stage,) = watch.of("point")
    assert stage.total == sum(numbers) == 3
    watch.check()


def grid_field() -> xr.Dataset:
    t = np.linspace(0.0, 5.0, 60)
    values = 1.0 + np.exp(-t)[:, None] * [1.0, 2.0, 3.0]
    field = xr.Dataset(
        {"x": (("time", "z"), values, {"units": "1"})}, coords={"time": t, "z": [0.0, 1.0, 2.0]}
    )
    field["time"].attrs["units"], field["z"].attrs["units"] = "s", "m"
    return field


def test_what_fails_leaves_its_stage() -> None:
    watch = Recorder()
    with pytest.raises(ZeroDivisionError), watch.stage(2, "piece"):
        1 / 0  # noqa: B018
    for _ in (pieces := count_pieces(watch, [1, 2], "piece")):
        break
    pieces.close()
    assert [(each.done, each.over) for each in watch.stages] == [(0, True), (0, True)]


def test_whoever_is_not_asked_is_silent(prey: ep.Trajectory, capfd: pytest.CaptureFixture) -> None:
    """Whatever can tell its progress does so on request; simulators ask for themselves."""
    asking = {
        entry.name: parameter.default
        for entry in dotted_names().values()
        if inspect.isfunction(value := entry.load())
        and (parameter := inspect.signature(value).parameters.get("progress"))
    }
    simulators = {name for name, default in asking.items() if default is True}
    assert simulators == {"simulate", "simulate_2d"}
    assert {asking[name] for name in set(asking) - simulators} == {False}
    assert {"discover", "estimate", "refine", "pointwise", "discover_shared"} <= set(asking)
    ep.discover(prey, LIBRARY, regression())
    assert capfd.readouterr() == ("", "")


def test_logs_and_pipes_see_no_bars(prey: ep.Trajectory, capfd: pytest.CaptureFixture) -> None:
    ep.discover(prey, LIBRARY, regression(), progress=True)
    assert capfd.readouterr() == ("", "")


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_terminal_sees_label_count_and_unit_and_then_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    with Bars().stage(3, "system", "refined") as advance:
        first = terminal.getvalue()
        assert "refined:   0%" in first
        assert "0/3 system [" in first
        advance(3)
    assert terminal.getvalue().endswith("\r")
    assert not terminal.getvalue().split("\r")[-2].strip()


@pytest.mark.parametrize("columns", [0, 100])
def test_a_terminal_that_does_not_know_its_size_sees_bars(
    columns: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Such as one of a container, which reports no rows."""
    reader, terminal = os.openpty()
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 0, columns, 0, 0))
    with os.fdopen(reader, "rb", buffering=0) as shown, os.fdopen(terminal, "w") as stream:
        monkeypatch.setattr(sys, "stderr", stream)
        with Bars().stage(3, "system", "refined"):
            stream.write("end\n")  # there is something to read in any case
            stream.flush()
        assert b"| 0/3 system [" in shown.read(4096)


def test_a_stage_that_cannot_be_counted_is_a_line(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    with Bars().stage(None, "", "free runs"):
        assert terminal.getvalue().strip() == "free runs ..."


def test_true_means_bars_and_a_function_is_told() -> None:
    assert as_progress(True) == Bars()
    assert as_progress(False) is SILENT
    watch, numbers = Recorder(), []
    assert as_progress(watch) is watch
    told = as_progress(numbers.append)
    assert isinstance(told, Told)
    with told.stage(2, "point") as advance:
        advance(2)
    assert numbers == [2]


def test_a_run_tells_what_it_reads_computes_and_draws(
    predator_prey: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`weak`, from its data to its figures; what these show is not the matter here."""
    config = programs.composed(
        "+exp=weak", "data=file", f"data.path={predator_prey}", f"output={tmp_path}",
        "n_windows=200", "n_points=[10]",
    )  # fmt: skip
    watch = Recorder()
    study = study_of(study_class(config.study), config)
    monkeypatch.setattr("ep2sindy.app.runner.draw", lambda figure, png, caption: "")
    monkeypatch.setattr("ep2sindy.report.folder.RunFolder.write_figure", lambda *_: b"")
    monkeypatch.setattr("ep2sindy.report.tensorboard.Board.image", lambda *_: None)
    monkeypatch.setattr("ep2sindy.app.runner.page_html", lambda *_, **__: "")
    with start_run(config) as run:
        watched = Run(**{name: getattr(run, name) for name in run.__dict__} | {"watch": watch})
        outcome = study.compute(watched)
        blank = Captioned(lambda: None, "")
        monkeypatch.setattr(type(outcome), "figures", lambda _: {"one": blank, "two": blank})
        write(watched, outcome, study)
    assert watch.labels[0] == "data"
    (settings,) = watch.of("setting")
    assert settings.total == len(outcome.fitted)
    assert watch.stages[-1].unit == "figure"
    assert watch.stages[-1].total == 2
    watch.check()
