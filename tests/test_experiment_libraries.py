import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hydra import compose, initialize_config_dir
from hydra.errors import HydraException
from hydra.utils import instantiate
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from ep2sindy.discovery.discover import discover
from ep2sindy.library.library import polynomial
from ep2sindy.model.model import SparseModel
from experiments import libraries
from experiments.build import check_overrides, open_prepared_field, recipe_of, selection_of
from experiments.run import innermost

ROOT = Path(__file__).resolve().parents[1]
EXPERIMENTS = sorted(path.stem for path in (ROOT / "conf" / "exp").glob("*.yaml"))


def composed(*overrides: str) -> DictConfig:
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        return compose("config", overrides=list(overrides))


def breathing(path: Path, output: Path) -> list[str]:
    """Overrides that run `+exp=breathing` on a file."""
    return [
        "+exp=breathing",
        "data=file",
        f"data.path={path}",
        "data.variables.R_ion.name=R_ion",
        "data.variables.u_iz.name=u_iz",
        f"output={output}",
        "bootstraps.n=8",
    ]


@pytest.fixture(scope="module")
def breathing_run(predator_prey: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder of one breathing experiment on known data."""
    output = tmp_path_factory.mktemp("outputs")
    return run(composed(*breathing(predator_prey, output)))


def summary_of(folder: Path) -> dict:
    return json.loads((folder / "summary.json").read_text())


def test_breathing_finds_predator_and_prey(breathing_run: Path) -> None:
    summary = summary_of(breathing_run)
    simple = summary["models"]["simple"]
    ions, neutrals = simple["equations"]["n_i"], simple["equations"]["n_n"]
    # Second-order differences at 1.5 us on a 14 kHz wave: (omega dt)^2 / 6 = 0.3 %, and the
    # smoothing window flattens peaks by about 1 %.
    assert ions["terms"] == pytest.approx({"n_i": -1.64e5, "n_i*n_n": 4.66e-14}, rel=0.02)
    assert neutrals["terms"] == pytest.approx({"n_n": 4.39e4, "n_i*n_n": -4.66e-14}, rel=0.02)
    assert simple["trajectory"]["f_kHz"] == pytest.approx(summary["data"]["f_kHz"], rel=0.02)
    assert set(summary["models"]) == {"simple", "ionization", "velocity"}
    for key in ("n_terms", "r2_test", "d_pareto", "text"):
        assert key in ions


def test_a_run_folder_holds_all_that_it_takes_to_look_again(breathing_run: Path) -> None:
    folder = breathing_run
    files = {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()}
    assert {
        "config.yaml",
        "provenance.json",
        "run.log",
        "summary.json",
        "report.html",
        "models/simple.json",
        "tables/front_velocity.csv",
        "tables/comparison.csv",
        "figures/data.png",
        "figures/trajectories.pdf",
    } <= files
    assert any(name.startswith("tensorboard/events") for name in files)
    model = SparseModel.load(folder / "models" / "simple.json")
    assert model.terms("n_i") == summary_of(folder)["models"]["simple"]["equations"]["n_i"]["terms"]
    page = (folder / "report.html").read_text()
    for image in ("figures/data.png", "figures/phase.png", "figures/front_simple.png"):
        assert image in page
        assert image in files


def test_a_fixed_seed_gives_the_same_summary(
    breathing_run: Path, predator_prey: Path, tmp_path: Path
) -> None:
    again = run(composed(*breathing(predator_prey, tmp_path)))
    assert summary_of(again) == summary_of(breathing_run)


def test_discover_runs_on_a_csv_of_any_system(tmp_path: Path) -> None:
    t = np.linspace(0.0, 20.0, 1001)
    damped = 3.0 * np.sqrt(1 - 0.01)
    x = np.exp(-0.3 * t) * np.cos(damped * t)
    v = -0.3 * x - damped * np.exp(-0.3 * t) * np.sin(damped * t)
    table = np.column_stack([t, x, v])
    path = tmp_path / "run.csv"
    np.savetxt(path, table, delimiter=",", header="time,x,v", comments="")
    config = composed(
        "+exp=discover",
        "data=file",
        f"data.path={path}",
        "data.z.name=null",
        "data.variables.n_i.name=null",
        "data.variables.n_n.name=null",
        "+data.variables.x.name=x",
        "+data.variables.x.unit=1",
        "+data.variables.v.name=v",
        "+data.variables.v.unit=1",
        "trajectory.states=[x,v]",
        "search=best_subset",
        f"output={tmp_path}",
    )
    found = summary_of(run(config))["models"]["model"]["equations"]
    assert found["x"]["terms"] == pytest.approx({"v": 1.0}, rel=0.01)
    assert found["v"]["terms"]["x"] == pytest.approx(-9.0, rel=0.05)




@pytest.mark.parametrize("search", ["adaptive_lasso", "stlsq", "best_subset"])
def test_every_search_runs(search: str, predator_prey: Path, tmp_path: Path) -> None:
    config = composed(
        "+exp=discover",
        "data=file",
        f"data.path={predator_prey}",
        "trajectory.states=[n_i,n_n]",
        f"search={search}",
        f"output={tmp_path}",
    )
    equations = summary_of(run(config))["models"]["model"]["equations"]
    assert set(equations["n_i"]["terms"]) == {"n_i", "n_i*n_n"}


@pytest.mark.parametrize(
    ("formulation", "selection"),
    [
        ("differential", "knee"),
        ("kalman", "log_knee"),
        ("kalman", "ebic"),
        ("weak", "knee"),
        ("weak", "bic"),
        ("weak", "ebic"),
        ("weighted_weak", "ebic"),
        ("weak_boxes", "knee"),
    ],
)
def test_every_formulation_and_selection_finds_predator_and_prey(
    formulation: str, selection: str, predator_prey: Path, tmp_path: Path
) -> None:
    config = composed(
        *breathing(predator_prey, tmp_path), f"formulation={formulation}", f"selection={selection}"
    )
    to_trajectory = instantiate(config.trajectory, _convert_="all")
    run = to_trajectory(open_prepared_field(config), inputs=[], label="")
    found = discover(
        [run],
        polynomial(["n_i", "n_n"], degree=2),
        recipe_of(config),
        seed=0,
    )
    # Least exact are the differential form, as above, and boxes of a hundred samples, over which
    # the trapezoidal rule leaves 0.1 %.
    truth = {"n_i": -1.64e5, "n_i*n_n": 4.66e-14}
    assert found.model.terms("n_i") == pytest.approx(truth, rel=0.02)
    truth = {"n_n": 4.39e4, "n_i*n_n": -4.66e-14}
    assert found.model.terms("n_n") == pytest.approx(truth, rel=0.02)


@pytest.mark.parametrize(
    "rule", sorted(p.stem for p in (ROOT / "conf" / "selection").glob("*.yaml"))
)
def test_a_selection_on_the_command_line_is_every_librarys(rule: str, tmp_path: Path) -> None:
    config = composed(*breathing(tmp_path, tmp_path), f"selection={rule}")
    expected = instantiate(config.selection)
    for case in config.libraries.values():
        assert type(instantiate(selection_of(case, config.selection))) is type(expected)


def test_the_weak_form_and_a_criterion_go_from_the_command_line_to_the_report(
    predator_prey: Path, tmp_path: Path
) -> None:
    folder = libraries.run(
        composed(
            *breathing(predator_prey, tmp_path),
            "formulation=weak",
            "selection=ebic",
            "depth=2",
            "~libraries.ionization",
            "~libraries.velocity",
        )
    )
    found = summary_of(folder)["models"]["simple"]["equations"]
    # The field was integrated to 1e-8; bumps add no error of their own.
    assert found["n_i"]["terms"] == pytest.approx({"n_i": -1.64e5, "n_i*n_n": 4.66e-14}, rel=1e-6)
    assert found["n_i"]["r2_test"] is None
    front = pd.read_csv(folder / "tables" / "front_simple.csv")
    for state, rows in front.groupby("equation"):
        assert rows.loc[rows["selected"], "EBIC"].item() == rows["EBIC"].min()
        assert found[state]["EBIC"] == pytest.approx(rows["EBIC"].min())
        assert rows["n_terms"].value_counts().max() == 2
    log = (folder / "run.log").read_text()
    for words in ("selection: EBIC(gamma=1.0", "R2 train", "weighted: n_i' = -1.64e+05 n_i"):
        assert words in log


def test_a_library_may_have_a_knee_norm_of_its_own(breathing_run: Path) -> None:
    log = (breathing_run / "run.log").read_text()
    assert "simple: 6 terms in n_i, n_n; selection: Knee(n_norm='library')" in log
    assert log.count("selection: Knee(n_norm='max_terms')") == 2


def test_the_project_simulates_its_own_data(tmp_path: Path) -> None:
    config = composed(
        "+exp=breathing",
        "data.duration_s=0.3e-3",
        "data.warm_up_s=0.0",
        "data.n_cells=30",
        "data.progress=false",
        f"data.cache={tmp_path / 'cache'}",
        "bootstraps.n=4",
        "libraries.ionization.degree=2",
        f"output={tmp_path}",
    )
    folder = run(config)
    assert summary_of(folder)["data"]["n_samples"] == 201
    assert "simulation: " in (folder / "run.log").read_text()
    assert len(list((tmp_path / "cache").iterdir())) == 1








@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["+search.max_term=3"], "unexpected keyword argument 'max_term'"),
        (["selection.n_norm=libary"], "n_norm must be 'library' or 'max_terms'"),
        (["+libraries.simple.degre=3"], "libraries.simple may have"),
        (["libraries.simple.degree=-1"], "degree must be a whole number, zero or more: -1"),
        (["+seeds=1"], "unknown keys ['seeds']; there are "),
        (["seed=abc"], "seed must be a whole number"),
        (["depth=0"], "depth must be a whole number, one or more: 0 came"),
        (["depth=1.5"], "depth must be a whole number, one or more: 1.5 came"),
        (["libraries.simple.n_norm=libary"], "n_norm must be 'library' or 'max_terms'"),
        (["rollout_s=-1"], "rollout_s must be a positive number"),
        (["trajectory.zone.z=[0.5,0.6]"], "a zone must hold grid points"),
        (["libraries.simple.variables=[n_i,q]"], "unknown variables ['q']; this field has"),
        (["bootstraps.n_culled=6"], "n_culled must leave a term: 6 of 6 would go"),
        (
            ["prepare=[{_target_:ep2sindy.crop,start:1}]"],
            "prepare[0], crop: got an unexpected keyword argument 'start'",
        ),
        (["output=Makefile"], "choose another with output=PATH"),
        (["~trajectory.states", "+trajectory.states=???"], "trajectory.states"),
    ],
)
def test_settings_that_cannot_work_are_refused(
    overrides: list[str], message: str, predator_prey: Path, tmp_path: Path
) -> None:
    config = composed(*breathing(predator_prey, tmp_path), *overrides)
    with pytest.raises((ValueError, OSError, HydraException, OmegaConfBaseException)) as caught:
        run(config)
    assert message in str(innermost(caught.value))




def test_an_error_is_kept_in_the_log(predator_prey: Path, tmp_path: Path) -> None:
    config = composed(*breathing(predator_prey, tmp_path), "bootstraps.n_culled=6")
    with pytest.raises(ValueError, match="n_culled"):
        run(config)
    (folder,) = (tmp_path / "breathing").iterdir()
    assert "ended early: ValueError: n_culled must leave" in (folder / "run.log").read_text()


