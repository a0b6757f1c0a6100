import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from omegaconf import DictConfig

from ep2sindy.app.runner import run_config
from ep2sindy.data.open import write_field
from tests import programs
from tests.fields import along_channel
from tests.programs import summary_of

ESTIMATES = {"constrained": {"L_m", "g_inj", "eps"}, "free": {"L_m", "g_inj", "eps_i", "eps_n"}}
FITS = [name + end for name in ("free", "constrained") for end in ("", "_refined")]
POINTS = (
    "points=[{V_D_V: 200.0, mdot_mg_s: 5.0, data: {operating_point: {neutral_speed: 320.0}}},"
    "{V_D_V: 300.0, mdot_mg_s: 2.0, data: {operating_point: {neutral_speed: 195.0}}},"
    "{V_D_V: 300.0, mdot_mg_s: [4.0, 5.0]}, {V_D_V: 400.0, mdot_mg_s: 5.0}]"
)


def composed(*overrides: str) -> DictConfig:
    return programs.composed("+exp=parametric", *overrides)


def toy(output: Path) -> list[str]:
    """Overrides that run the experiment on short, coarse simulations."""
    return [
        f"output={output}",
        f"data.cache={output / 'cache'}",
        "data.duration_s=2.0e-3",
        "data.warm_up_s=0.5e-3",
        "data.n_cells=30",
        "parallel=serial",
        "windows.n_windows=20",
    ]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder of five operating points."""
    toy_run = composed(*toy(tmp_path_factory.mktemp("outputs")), POINTS)
    return programs.computed(toy_run).folder


def of(fit: str) -> str:
    return fit.removesuffix("_refined")


def test_the_summary_has_every_point_fit_and_quantity(folder: Path) -> None:
    summary = summary_of(folder)
    points = [(p["V_D_V"], p["mdot_mg_s"]) for p in summary["points"]]
    assert points == [(200, 5), (300, 2), (300, 4), (300, 5), (400, 5)]
    for point in summary["points"]:
        assert point["status"] == "oscillating"
        assert 8.0 < point["f_kHz"] < 25.0
    assert [each["fit"] for each in summary["fits"]] == FITS * 5
    for each in summary["fits"]:
        assert max(each["r2_n_i"], each["r2_n_n"]) <= 1.0
        assert (each["loss"] is None) == (each["status"] == "fitted")
    names = {(fit, q) for fit in FITS for q in ESTIMATES[of(fit)]}
    at = {(q["V_D_V"], q["mdot_mg_s"], q["fit"], q["quantity"]): q for q in summary["quantities"]}
    assert set(at) == {(*point, *name) for point in points for name in names}
    for each in at.values():
        assert each["low"] < each["value"] < each["high"]
    injected = [at[300, m, "constrained", "g_inj"]["value"] for m in (2, 4, 5)]
    assert injected == sorted(injected)


def test_control_laws_have_one_term_of_five_points(folder: Path) -> None:
    summary = summary_of(folder)
    laws = summary["control_laws"]
    assert set(laws) == {f"{fit}/{name}" for fit in FITS for name in ESTIMATES[of(fit)]}
    for name, law in laws.items():
        assert re.fullmatch(rf"{law['quantity']} = \S+( \S+)?", law["law"])
        assert 0.0 < law["search_error"] < 1.0
        assert summary["headline"][f"{name}/search_error"] == law["search_error"]


def test_the_headline_is_the_fit_that_errs_least_at_points_left_out(folder: Path) -> None:
    summary = summary_of(folder)
    errors = {trial["fit"]: trial["error"] for trial in summary["trials"]}
    assert list(errors) == FITS
    best = min(errors, key=lambda fit: errors[fit])
    assert summary["best_fit"] == best
    assert summary["headline"]["window_error"] == errors[summary["law"]["fit"]]


def test_each_point_is_simulated_where_it_operates(folder: Path) -> None:
    names = sorted(path.name[:19] for path in (folder.parents[1] / "cache").iterdir())
    points = ("200V_5", "300V_2", "300V_4", "300V_5", "400V_5")
    assert names == [f"thruster_{point}mgs_" for point in points]


def test_tables_figures_and_page_are_written(folder: Path) -> None:
    quantities = pd.read_csv(folder / "tables" / "quantities.csv")
    at = quantities.set_index(["V_D_V", "mdot_mg_s", "fit", "quantity"])
    assert at["thesis"][200.0, 5.0, "constrained", "g_inj"] == 2.72e23
    assert at["thesis"][300.0, 2.0, "free", "eps_n"] == 0.67
    assert np.isnan(at["thesis"][300.0, 2.0, "free_refined", "eps_n"])
    trials = pd.read_csv(folder / "tables" / "trials.csv")
    assert (trials["fit"].tolist(), trials["chosen"].sum()) == (FITS, 1)


def breathing_file(path: Path, *, amplitude: float, dt_s: float, rate: float = 1.0) -> Path:
    """A field whose ions obey the free model by construction of R_ion; neutrals swing."""
    t = dt_s * np.arange(round(1.5e-3 / dt_s))
    phase = 2 * np.pi * 14e3 * t
    n_i = 1e18 * (1 + amplitude * np.sin(phase))
    n_n = rate * 4e18 * (1 + 0.5 * amplitude * np.cos(phase))
    data = {
        "n_i": (n_i, "m^-3"),
        "n_n": (n_n, "m^-3"),
        "R_ion": (5e-14 * (1 + 0.6 * amplitude * np.cos(phase + 0.4)), "m^3/s"),
        "u_iz": (4e3 * (1 + 0.3 * amplitude * np.sin(phase + 1)), "m/s"),
    }
    write_field(along_channel(t, [0.016, 0.02, 0.024], data), path)
    return path


def own_files(output: Path, *paths: Path) -> list[str]:
    """Overrides that take these files for operating points of 200 V, 300 V and so on."""
    points = (
        f"{{V_D_V: {200.0 + 100.0 * k}, mdot_mg_s: 5.0, data: {{path: {path}}}}}"
        for k, path in enumerate(paths)
    )
    return [
        *toy(output)[5:],
        *programs.on_file(Path("null"), output, "R_ion", "u_iz"),
        "parameters={V_D_V: null, mdot_mg_s: null}",
        f"points=[{','.join(points)}]",
    ]


def test_own_files_and_points_that_do_not_oscillate(tmp_path: Path) -> None:
    first = breathing_file(tmp_path / "a.nc", amplitude=0.5, dt_s=1.5e-6)
    second = breathing_file(tmp_path / "b.nc", amplitude=0.4, dt_s=2e-6, rate=1.1)
    still = breathing_file(tmp_path / "c.nc", amplitude=1e-3, dt_s=1.5e-6)
    dead = breathing_file(tmp_path / "d.nc", amplitude=0.0, dt_s=1.5e-6)
    given = own_files(tmp_path, first, second, still, dead)
    found = programs.computed(composed(*given, "thesis=null"))
    summary = found.summary
    assert [p["status"] for p in summary["points"]] == ["oscillating"] * 2 + ["steady"] * 2
    assert [p["dt_s"] for p in summary["points"][:3]] == pytest.approx([1.5e-6, 2e-6, 1.5e-6])
    assert {each["V_D_V"] for each in summary["fits"]} == {200.0, 300.0}
    assert {each["V_D_V"] for each in summary["quantities"]} == {200.0, 300.0}
    assert summary["control_laws"] == {}
    found.check_figures("trends_free", "trends_constrained")
    assert np.isnan(found.report.headline["free/L_m/search_error"])
    (warning,) = [text for text in found.warnings if "no law of whole models" in text]
    assert "'mdot_mg_s' is 5 at all 2 operating points" in warning


def test_nothing_that_oscillates_is_a_result(tmp_path: Path) -> None:
    still = breathing_file(tmp_path / "c.nc", amplitude=0.0, dt_s=1.5e-6)
    folder = run_config(composed(*own_files(tmp_path, still), "trajectory.zone=null"))
    assert not (folder / "figures").exists()
    assert summary_of(folder)["points"][0]["status"] == "steady"
