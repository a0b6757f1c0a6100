import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from omegaconf import DictConfig

import ep2sindy as ep
from tests.programs import composed, computed

# A growth rate that damps towards a cycle, as those found in the discharge current do.
CYCLE = {"1": 7.93e9, "I": -2.44e9, "I*g": 1.07e4, "g^3": -1.47e-6}


@cache
def signal(n_periods: float) -> tuple[np.ndarray, np.ndarray]:
    library = ep.polynomial(["I", "g"], degree=3)
    coef = ep.model.coef_matrix(library, [{"I*g": 1.0}, CYCLE])
    model = ep.SparseModel(library, ["I", "g"], coef)
    t = 1.5e-6 * np.arange(round(54 * (n_periods + 10)))
    return t[:-540], model.simulate(t, [2.0, 1e5]).states[540:, 0]


def scope(path: Path, t: np.ndarray, x: np.ndarray) -> Path:
    np.savetxt(path, np.column_stack([t, x]), delimiter=",", header="time,I", comments="")
    return path


def toy(path: Path, output: Path, *more: str) -> list[str]:
    return [
        "+exp=trace", "data=file", f"data.path={path}", "signal=I", "unit=A", f"output={output}",
        "search.n_best=2", "search.max_terms=4", "depth=2", "selection.n_starts=1",
        "selection.n_windows=6", "selection.n_folds=2", *more,
    ]  # fmt: skip


def glance(path: Path, output: Path, *more: str) -> list[str]:
    """The description of a smoothed signal; the model of one term has no free run."""
    few = ("depth=1", "search.n_best=1", "search.max_terms=1", "selection=ebic")
    given = [o for o in toy(path, output, *few) if not o.startswith("selection.")]
    return [*given, "tried=[{how: rate}]", *more]


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return scope(tmp_path_factory.mktemp("scope") / "scope.csv", *signal(24.0))


@pytest.mark.slow
def test_hidden_states_that_do_not_fit_are_shown_if_asked_for(tmp_path: Path) -> None:
    t = np.linspace(0.0, 50.0, 501)
    path = scope(tmp_path / "scope.csv", t, np.sin(t) ** 3)  # no linear equations make it
    found = computed(composed(*glance(path, tmp_path, "tried=[{how: hidden, degree: 1}]")))
    assert found.summary["signal"]["how"] == "hidden"
    assert found.summary["signal"]["reason"] == "set"
    assert found.summary["signal"]["lack_of_fit"]
    assert not found.summary["models"]["trace"]["intervals"]


def test_one_column_of_a_file_becomes_a_sustained_model(record: Path, tmp_path: Path) -> None:
    summary = computed(composed(*toy(record, tmp_path, "tried=[{how: rate}]"))).summary
    run = summary["evaluations"]["trace"]
    assert run["status"] == "sustained"
    assert abs(run["f_error"]) < 0.005
    assert run["amplitude_ratio"]["I"] == pytest.approx(1.0, abs=0.03)
    assert run["waveform_error"]["I"] < 0.1
    assert run["multiplier"] < 0.5
    assert summary["models"]["trace"]["equations"]["I"] == pytest.approx({"I*g": 1.0})
    assert summary["signal"]["how"] == "rate"
    assert summary["signal"]["known"] == {"I": "I*g"}
    assert summary["data"]["units"] == {"I": "A", "g": "s^-1"}
    assert summary["signal"]["lack_of_fit"]
    forecast = summary["forecasts"]["trace"]
    assert {"model", "harmonics", "autoregression", "neighbours"} <= set(forecast["nrmse"])
    assert max(forecast["nrmse"]["model"]) < 0.3
    (tried,) = summary["tried"]
    assert tried["n_states"] == 2
    assert tried["error"] < 0.3


@pytest.mark.slow
def test_a_signal_of_either_sign_can_be_taken(tmp_path: Path) -> None:
    t = 0.12 * np.arange(850)  # 16 periods
    run = ep.systems.van_der_pol(mu=0.5).model.simulate(t, [2.0, 0.0])
    path = scope(tmp_path / "scope.csv", run.t, run.states[:, 0])
    given = toy(path, tmp_path, "search.max_terms=3", "tried=[{how: derivative}]")
    found = computed(composed(*given))
    assert found.summary["signal"]["reason"] == "set"
    equations = found.summary["models"]["trace"]["equations"]
    assert equations["I"] == {"v": 1.0}
    assert set(equations["v"]) == {"I", "v", "I^2*v"}
    assert found.summary["evaluations"]["trace"]["status"] == "sustained"


def test_a_signal_that_does_not_repeat_itself_is_tried_in_three_states(tmp_path: Path) -> None:
    run = ep.lorenz().trajectory().window(0, 2500)
    path = scope(tmp_path / "scope.csv", run.t, run.states[:, 0])
    both = "tried=[{how: auto, degree: 2}, {how: auto, degree: 2, n_states: 3}]"
    found = computed(composed(*glance(path, tmp_path, both)))
    assert [each["n_states"] for each in found.summary["tried"]] == [2, 3]


@pytest.mark.slow
def test_the_law_of_chaos_is_found_in_one_of_its_states(tmp_path: Path) -> None:
    run = ep.lorenz().trajectory(noise=0.02, rng=2)
    path = scope(tmp_path / "scope.csv", run.t, run.states[:, 0])
    found = computed(composed(*toy(path, tmp_path))).summary
    assert [(each["how"], each["n_states"]) for each in found["tried"]] == [("hidden", 3)]
    equations = found["models"]["trace"]["equations"]
    assert equations["I"] == {"v": 1.0}
    assert set(equations["v"]) == {"v", "I*w"}
    assert set(equations["w"]) == {"1", "w", "I^2", "I*v"}
    assert found["evaluations"]["trace"]["status"].startswith("follows the samples for")
    assert max(found["forecasts"]["trace"]["nrmse"]["model"]) < 0.2


def test_a_short_record_is_assessed_on_all_of_it(tmp_path: Path) -> None:
    path = scope(tmp_path / "scope.csv", *signal(6.4))
    found = computed(composed(*glance(path, tmp_path, "held_out=0.2")))
    assert found.summary["signal"]["n_fitted"] == found.summary["data"]["n_samples"]
    assert "forecasts" not in found.summary


@pytest.mark.parametrize(
    ("change", "more", "message"),
    [
        (lambda t, x: (t[:200], x[:200]), [], "must hold 6 periods or more"),
        (lambda t, x: (t, np.random.default_rng(0).random(len(t))), [], "must oscillate"),
        (lambda t, x: (t, x - 1.0), ["tried=[{how: rate}]"], "needs a positive signal: I falls"),
    ],
)
def test_what_cannot_be_taken_is_refused(change, more, message, tmp_path: Path) -> None:
    path = scope(tmp_path / "scope.csv", *change(*signal(10.0)))
    with pytest.raises(ValueError, match=message):
        computed(composed(*toy(path, tmp_path, *more)))


def recognised(path: Path, header: str, *more: str) -> DictConfig:
    """A glance at a file that names and units alone describe."""
    t, x = signal(12.0)
    np.savetxt(path, np.column_stack([t, x]), delimiter=",", header=header, comments="")
    own = ("data=file", "signal=I", "unit=A")
    few = [each for each in glance(path, path.parent) if each not in own]
    return composed(*few, "data=recognised", *more)


@pytest.mark.slow
def test_a_recognised_signal_without_a_unit_takes_the_one_given(tmp_path: Path) -> None:
    config = recognised(tmp_path / "scope.csv", "time [s],I", "signal=I", "unit=mA")
    found = computed(config)
    assert found.summary["data"]["units"] == {"I": "A", "g": "s^-1"}
    mean = signal(12.0)[1].mean()
    assert found.report.tables["states"]["I"].mean() == pytest.approx(1e-3 * mean, rel=1e-2)


@pytest.mark.slow
def test_a_mean_that_was_lost_is_asked_for_and_given_back(tmp_path: Path) -> None:
    t, x = signal(12.0)
    path = scope(tmp_path / "scope.csv", t, x - x.mean())
    lost = computed(composed(*glance(path, tmp_path, "tried=[{how: auto}]")))
    assert lost.summary["signal"]["how"] == "derivative"
    assert "offset=MEAN gives it back" in " ".join(lost.log.split())
    given = computed(composed(*glance(path, tmp_path, "tried=[{how: auto}]", f"offset={x.mean()}")))
    assert given.summary["signal"]["how"] == "rate"
    assert "offset=MEAN" not in given.log


def test_one_column_of_a_file_becomes_the_law_with_intervals(record: Path, tmp_path: Path) -> None:
    found = computed(composed(*toy(record, tmp_path))).summary
    assert found["signal"]["how"] == "hidden"
    model = found["models"]["trace"]
    assert not found["signal"]["lack_of_fit"]
    assert model["equations"]["I"] == pytest.approx({"I*g": 1.0})
    assert model["equations"]["g"] == pytest.approx(CYCLE, rel=0.02)
    for term, (low, high) in model["intervals"]["g"].items():
        assert low < CYCLE[term] < high
    assert found["evaluations"]["trace"]["status"].startswith("follows the samples for")


@pytest.mark.slow
def test_a_mean_that_was_lost_is_fitted_with_its_interval(tmp_path: Path) -> None:
    t, x = signal(12.0)
    noisy = x + 0.02 * x.std() * np.random.default_rng(0).standard_normal(len(x))
    path = scope(tmp_path / "scope.csv", t, noisy - x.mean())
    found = computed(composed(*toy(path, tmp_path, "offset=fit"))).summary
    (words,) = [each for each in found["signal"]["done"] if "offset" in each]
    value, low, high = map(float, re.findall(r"-?\d+\.?\d*(?= A|(?: to)|\))", words))
    assert low < x.mean() < high
    assert value == pytest.approx(x.mean(), rel=0.05)
    assert found["models"]["trace"]["equations"]["I"] == pytest.approx({"I*g": 1.0})
    assert found["signal"]["how"] == "hidden"


def test_an_offset_that_no_equations_tell_is_refused(tmp_path: Path) -> None:
    t = np.linspace(0.0, 50.0, 501)
    path = scope(tmp_path / "scope.csv", t, np.sin(t) ** 3)
    with pytest.raises(ValueError, match="offset=fit asks for equations"):
        computed(composed(*toy(path, tmp_path, "offset=fit", "tried=[{how: hidden, degree: 1}]")))
