import os
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from omegaconf import DictConfig, OmegaConf

from benchmarks.regions import TERMS, three_regions
from ep2sindy.app import runner
from ep2sindy.app.runner import run_config
from ep2sindy.app.schema import study_of
from ep2sindy.data.open import write_field
from ep2sindy.studies import pointwise
from ep2sindy.studies.resume import pieces_key
from tests import programs
from tests.programs import summary_of
from tests.test_resume import broken_and_resumed


def composed(*overrides: str) -> DictConfig:
    return programs.composed("+exp=pointwise", *overrides)


def key_of(*overrides: str) -> str:
    settings = OmegaConf.to_container(composed(*overrides), resolve=True)
    return pieces_key(settings, aside=pointwise.AFTERWARDS)


@pytest.fixture(scope="module")
def grid(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small file on (time, z, r)."""
    path = tmp_path_factory.mktemp("data") / "grid.nc"
    write_field(three_regions(n_z=6, n_r=5, n_samples=300).field, path)
    return path


def on_file(path: Path, folder: Path) -> list[str]:
    return [
        *programs.on_file(path, folder / "outputs", "u_iz", "u_ir", "R_ion"),
        "data.r.name=r",
        "keep=false",
        "parallel=serial",
        "bootstraps.n=6",
        "block_points=5",
        "max_regimes=3",
    ]


@pytest.fixture(scope="module")
def toy_run(grid: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run_config(composed(*on_file(grid, tmp_path_factory.mktemp("run"))))


def test_the_summary_counts_the_points(toy_run: Path) -> None:
    found = summary_of(toy_run)
    assert found["n_points"] == found["n_valid"] == 30
    assert found["status"] == {"fitted": 30}
    assert found["points_per_s"] == pytest.approx(30 / found["wall_s"])
    assert 1 <= found["n_regimes"] == len(found["equations"]) <= 3


def test_the_file_holds_every_map(toy_run: Path) -> None:
    with xr.open_dataset(toy_run / summary_of(toy_run)["file"]) as result:
        assert list(result["term"].values) == list(TERMS)
        for name in ("coef", "inclusion", "weight"):
            assert result[name].dims == ("equation", "term", "z", "r")
        for name in ("r2_test", "n_terms"):
            assert result[name].dims == ("equation", "z", "r")
        assert result["status"].attrs["flag_meanings"].split()[0] == "fitted"
        assert int(result["regime"].max()) + 1 == summary_of(toy_run)["n_regimes"]
        assert ((result["confidence"] >= 0) & (result["confidence"] <= 1)).all()


def test_points_and_figures_go_to_tensorboard(toy_run: Path) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(toy_run / "tensorboard")).Reload()
    assert {"coefficients", "regimes", "quality"} <= set(events.Tags()["images"])


def test_a_line_of_points_without_an_optional_variable(grid: Path, tmp_path: Path) -> None:
    line = tmp_path / "line.nc"
    with xr.open_dataset(grid, decode_times=False) as field:
        write_field(field.isel(r=2, drop=True).load(), line)
    overrides = ["data.r.name=null", "data.variables.u_ir.name=null"]
    found = programs.computed(composed(*on_file(line, tmp_path), *overrides))
    assert found.summary["n_points"] == 6
    found.check_figures("regimes")
    with xr.open_dataset(found.folder / "pointwise.nc") as result:
        assert list(result["term"].values) == [name for name in TERMS if "u_ir" not in name]


def test_the_constant_needs_no_quotes(tmp_path: Path) -> None:
    config = composed(*on_file(tmp_path / "not_there.nc", tmp_path), "terms=[1,n_n]")
    assert study_of(pointwise.Study, config).library(lacking=()).names == ("1", "n_n")


def test_a_rate_table_that_has_changed_has_other_blocks(grid: Path, tmp_path: Path) -> None:
    table = tmp_path / "rates.csv"
    overrides = [
        *on_file(grid, tmp_path),
        f"prepare=[{{_target_: ep2sindy.thruster.ionization_rate, table: {table}}}]",
    ]
    table.write_text("1,1e-15\n100,1e-13\n")
    before = key_of(*overrides)
    table.write_text("1,5e-15\n100,5e-13\n")
    assert key_of(*overrides) != before


@pytest.mark.parametrize("place", ["mine/__init__.py", "mine.py"])
def test_own_code_that_has_changed_has_other_blocks(place: str, grid: Path, here: Path) -> None:
    source = here / place
    source.parent.mkdir(exist_ok=True)
    as_step = [*on_file(grid, here), "prepare=[{_target_: mine.half}]"]
    as_study = [*on_file(grid, here), "study=mine.maps"]
    keys = []
    for divisor in (2, 4):
        source.write_text(f"def half(field):\n    return field / {divisor}\n")
        keys += [key_of(*as_step), key_of(*as_study)]
    assert len(set(keys)) == 4


def test_other_settings_have_other_blocks(grid: Path, tmp_path: Path) -> None:
    def key(*overrides: str) -> str:
        return key_of(*on_file(grid, tmp_path), *overrides)

    same = [key(), key("max_regimes=2"), key("parallel=loky"), key("output=elsewhere")]
    assert len(set(same)) == 1
    others = [key("seed=1"), key("bootstraps.n=7"), key("terms=[n_n]"), key("selection=ebic")]
    assert len({*same, *others}) == 5
    later = grid.stat().st_mtime_ns + 10**9
    os.utime(grid, ns=(later, later))
    assert key() not in same


def test_a_run_that_was_broken_off_ends_with_the_same_file(
    grid: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("EP2SINDY_CACHE", str(tmp_path / "cache"))
    config = composed(*on_file(grid, tmp_path), "keep=true")
    whole = programs.computed(config)
    rest = broken_and_resumed(monkeypatch, config, after=3)
    # Not the bytes: older releases of h5netcdf write the time of day.
    one, other = (xr.load_dataset(each.folder / "pointwise.nc") for each in (whole, rest))
    xr.testing.assert_identical(one, other)
    assert "going on with the pieces" in rest.log


def test_two_parts_give_the_file_of_one_run(
    grid: Path, toy_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("EP2SINDY_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(runner, "precompile", lambda: None)  # into the new cache
    config = [*on_file(grid, tmp_path), "keep=true"]
    first, last = (run_config(composed(*config, f"parallel.part=[{k},2]")) for k in (1, 2))
    assert (
        "part 1 of 2 is done, and its pieces are kept; 3 pieces" in (first / "run.log").read_text()
    )
    assert not (first / "report.html").exists()
    xr.testing.assert_identical(
        *(xr.load_dataset(folder / "pointwise.nc") for folder in (toy_run, last))
    )
    assert not list(tmp_path.rglob("output.pkl"))  # removed once all is written


def test_a_part_that_is_not_kept_is_refused(grid: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"got part=\[1, 2\] where none are kept"):
        run_config(composed(*on_file(grid, tmp_path), "parallel.part=[1,2]"))


def test_continuity_is_found_at_every_point_of_a_simulated_channel(tmp_path: Path) -> None:
    small = ["data.n_cells=40", "data.duration_s=6e-4", "data.warm_up_s=2e-4", "data.cache=null"]
    folders = [f"output={tmp_path}/outputs", "keep=false", "parallel=serial"]
    found = programs.computed(composed("pointwise=continuity", "bootstraps.n=4", *small, *folders))
    with xr.open_dataset(found.folder / "pointwise.nc") as result:
        inside = result.where((result["z"] > 0.003) & (result["z"] < 0.022), drop=True)["coef"]
        ions, neutrals = inside.sel(equation="n_i"), inside.sel(equation="n_n")
        ionized = ions.sel(term="ionization")
        np.testing.assert_array_equal(ionized, -neutrals.sel(term="ionization"))
        np.testing.assert_allclose(ionized, 1.0, rtol=0.05)
        np.testing.assert_allclose(ions.sel(term="div_i"), -1.0, rtol=0.05)
        speeds = -neutrals.sel(term="grad_n")
        assert float(speeds.median()) == pytest.approx(338.0, rel=0.03)
