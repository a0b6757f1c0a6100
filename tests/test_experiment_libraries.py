import re
from pathlib import Path

import numpy as np
import pytest

from ep2sindy.app.runner import run_config
from ep2sindy.app.schema import study_of
from ep2sindy.discovery.discover import discover
from ep2sindy.library.library import polynomial
from ep2sindy.model.model import SparseModel
from ep2sindy.runtime.files import write_json
from ep2sindy.studies.libraries import Study
from tests.models import model_of
from tests.programs import ROOT, Computed, composed, computed, on_file, summary_of

NO_LIVING = ("sustained=none", "held_out=null", "forecasts=0")


def breathing(path: Path, output: Path) -> list[str]:
    """Overrides that run `+exp=breathing` on a file."""
    return [
        "+exp=breathing",
        *on_file(path, output, "R_ion", "u_iz"),
        "bootstraps.n=4",
        "sustained=free",  # predator and prey conserve nothing
        "sustained.search.max_terms=2",  # as many as the truth has
        "+sustained.selection.n_windows=6",
        "+sustained.selection.n_folds=2",
        "rollout_s=1.0e-3",
        "forecasts=2",
    ]


def plain(path: Path, output: Path) -> list[str]:
    """The same without a self-sustained model."""
    kept = [text for text in breathing(path, output) if "sustained" not in text]
    return [*kept, *NO_LIVING]


@pytest.fixture(scope="module")
def breathing_run(predator_prey: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder of one breathing experiment on known data."""
    output = tmp_path_factory.mktemp("outputs")
    return computed(composed(*breathing(predator_prey, output))).folder


def test_two_densities_alone_leave_out_what_needs_more_and_a_seed_fixes_what_is_found(
    predator_prey: Path, tmp_path: Path
) -> None:
    given = [text for text in plain(predator_prey, tmp_path) if "variables" not in text]
    found, again = (computed(composed(*given)) for _ in range(2))
    for name, each in (("one", found), ("other", again)):
        write_json(tmp_path / name, each.summary)
    assert (tmp_path / "one").read_text() == (tmp_path / "other").read_text()
    assert set(found.summary["models"]) == {"simple", "simple_thesis_terms"}
    assert "the library ionization is left out: the data have no R_ion" in found.log
    assert "the library velocity is left out: the data have no R_ion, u_iz" in found.log


def test_breathing_finds_predator_and_prey(breathing_run: Path) -> None:
    summary = summary_of(breathing_run)
    simple = summary["models"]["simple"]
    ions, neutrals = simple["equations"]["n_i"], simple["equations"]["n_n"]
    # Second-order differences at 1.5 us on a 14 kHz wave: (omega dt)^2 / 6 = 0.3 %, and the
    # smoothing window flattens peaks by about 1 %.
    assert ions == pytest.approx({"n_i": -1.64e5, "n_i*n_n": 4.66e-14}, rel=0.02)
    assert neutrals == pytest.approx({"n_n": 4.39e4, "n_i*n_n": -4.66e-14}, rel=0.02)
    run = summary["evaluations"]["simple"]
    assert run["f_error"] == pytest.approx(0.0, abs=0.02)
    refitted = {"simple_sustained", "simple_thesis_terms"}
    assert set(summary["models"]) >= {"simple", "ionization", "velocity"} | refitted


def test_breathing_ends_in_a_model_that_is_sustained(breathing_run: Path) -> None:
    found = summary_of(breathing_run)
    run, model = (found[key]["simple_sustained"] for key in ("evaluations", "models"))
    assert run["status"].startswith("follows the samples for")
    assert run["f_error"] == pytest.approx(0.0, abs=1e-4)
    assert run["waveform_error"] == pytest.approx({"n_i": 0.0, "n_n": 0.0}, abs=1e-2)
    assert run["amplitude_ratio"] == pytest.approx({"n_i": 1.0, "n_n": 1.0}, abs=1e-2)
    assert set(found["sustained"]) == {"simple_sustained"}  # the others have inputs
    sustained = found["sustained"]["simple_sustained"]
    assert sustained["n_terms"] == 4
    assert sustained["stability"] == "neutral"  # predator and prey
    assert sustained["multiplier"] == pytest.approx(1.0, abs=1e-3)
    ions = model["equations"]["n_i"]["n_i"]
    assert ions == pytest.approx(-1.64e5, rel=1e-4)
    low, high = model["intervals"]["n_i"]["n_i"]  # the spread over windows: the model may be wrong
    assert low < ions < high
    assert not {"balance_simple", "terms_simple"} & {*found}  # free terms are no processes


def test_a_run_folder_holds_all_that_it_takes_to_look_again(breathing_run: Path) -> None:
    folder = breathing_run
    files = ["config.yaml", "provenance.json", "report.html", "tables/front_velocity.csv"]
    for name in [*files, "tables/evaluations.csv"]:
        assert (folder / name).is_file(), name
    assert list(folder.glob("tensorboard/events*"))
    model = SparseModel.load(folder / "models" / "simple.json")
    assert model.terms("n_i") == summary_of(folder)["models"]["simple"]["equations"]["n_i"]


@pytest.fixture(scope="module")
def years(tmp_path_factory: pytest.TempPathFactory) -> Computed:
    """Predator and prey over thirty years, counted three times a year with 2 % of noise."""
    terms = {"hare": {"hare": 0.6, "hare*lynx": -0.03}, "lynx": {"lynx": -0.9, "hare*lynx": 0.03}}
    model = model_of(terms)
    t = np.linspace(0.0, 30.0, 91)
    states = model.simulate(t, [20.0, 10.0]).states
    states = states + 0.02 * states.std(axis=0) * np.random.default_rng(0).normal(size=states.shape)
    folder = tmp_path_factory.mktemp("years")
    table = np.column_stack([1900.0 + t, states])
    np.savetxt(folder / "run.csv", table, delimiter=",", header="time,hare,lynx", comments="")
    config = composed(
        "+exp=discover", "data=file", f"data.path={folder / 'run.csv'}", "data.z.name=null",
        "data.time.unit=year", "data.variables.n_i.name=null", "data.variables.n_n.name=null",
        "+data.variables.hare.name=hare", "+data.variables.hare.unit=1",
        "+data.variables.lynx.name=lynx", "+data.variables.lynx.unit=1",
        "trajectory.states=[hare,lynx]", "search=trajectory", "forecasts=0", f"output={folder}",
    )  # fmt: skip
    return computed(config)


def test_a_record_in_years_reads_in_years_and_is_kept_in_seconds(years: Computed) -> None:
    year = 365.25 * 86400.0
    found = years.summary["models"]["model"]["equations"]["hare"]
    # The estimator's own standard error at this noise is about one per cent.
    assert found == pytest.approx({"hare": 0.6 / year, "hare*lynx": -0.03 / year}, rel=0.05)
    assert years.summary["data"]["dt_s"] == pytest.approx(year / 3.0)
    mine = re.search(r"hare' = (\S+) hare - (\S+) hare lynx  <- selected", years.log)
    assert mine is not None
    assert [float(number) for number in mine.groups()] == pytest.approx([0.6, 0.03], rel=0.05)


def test_a_joint_search_says_what_the_samples_say(years: Computed) -> None:
    (found,) = years.summary["samples_model"]
    data = years.report.tables["rollout_model"]
    # Of 91 samples, some of which the parameters take: 10 % is a standard error and a half.
    noise = [found["noise_std"][name] / data[f"{name}_data"].std() for name in ("hare", "lynx")]
    assert noise == pytest.approx([0.02, 0.02], rel=0.25)
    tests = ("flow_error", "lack_of_fit", "too_few_samples")
    assert [found[name] for name in tests] == [0.0, None, None]


@pytest.mark.parametrize(
    ("formulation", "search", "selection"),
    [
        ("differential", "adaptive_lasso", "knee"),
        ("kalman", "best_subset", "log_knee"),
        ("weak", "stlsq", "ebic"),
        ("weighted_weak", "best_subset", "ebic"),
        ("weak_boxes", "best_subset", "knee"),
    ],
)
def test_every_formulation_search_and_selection_finds_predator_and_prey(
    formulation: str, search: str, selection: str, predator_prey: Path, tmp_path: Path
) -> None:
    chosen = (f"formulation={formulation}", f"search={search}", f"selection={selection}")
    config = composed(*plain(predator_prey, tmp_path), *chosen)
    study = study_of(Study, config)
    run = study.source.trajectory.trajectory(study.source.field(), inputs=[], label="")
    found = discover(run, polynomial(["n_i", "n_n"], degree=2), study.method, seed=0)
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
    search = ["search=trajectory", "bootstraps.n=0"] if rule == "evidence" else []
    config = composed(*breathing(tmp_path, tmp_path), *search, f"selection={rule}")
    study = study_of(Study, config)
    for case in study.libraries.values():
        assert type(case.method(study.method).selection) is type(study.method.selection)


def test_an_error_is_kept_in_the_log(predator_prey: Path, tmp_path: Path) -> None:
    config = composed(*breathing(predator_prey, tmp_path), "bootstraps.n_culled=6")
    with pytest.raises(ValueError, match="n_culled"):
        run_config(config)
    (folder,) = (tmp_path / "breathing").iterdir()
    assert "ended early: ValueError: n_culled must leave" in (folder / "run.log").read_text()


def test_a_state_that_shows_nothing_but_noise_has_no_law(tmp_path: Path) -> None:
    x = np.random.default_rng(1).standard_normal(60)
    text = "time,x\n" + "\n".join(f"{k},{value:.6f}" for k, value in enumerate(x))
    (tmp_path / "noise.csv").write_text(text)
    found = computed(
        composed(
            "+exp=discover", "data=recognised", f"data.path={tmp_path / 'noise.csv'}",
            "data.units={time: s}", "trajectory.states=[x]", f"output={tmp_path}",
        )
    )  # fmt: skip
    assert "model: no equations found" in " ".join(found.log.split())
