from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from omegaconf import DictConfig

import ep2sindy as ep
from benchmarks import known_laws
from ep2sindy.app import runner
from ep2sindy.app.runner import run_config
from ep2sindy.app.schema import study_of
from ep2sindy.data.open import write_field
from ep2sindy.operating.law import OperatingLaw
from ep2sindy.operating.map import map_points
from ep2sindy.studies import points as studied
from tests import programs
from tests.models import lienard
from tests.programs import summary_of

POINTS = "points=[{V_D_V: [280.0, 320.0], mdot_mg_s: [5.0, 5.5]}, {V_D_V: 150.0, mdot_mg_s: 2.0}]"


def composed(*overrides: str) -> DictConfig:
    return programs.composed("+exp=predict", *overrides)


def toy(output: Path) -> list[str]:
    """Short, coarse simulations, few windows and a small map."""
    return [
        f"output={output}", f"data.cache={output / 'cache'}", "data.duration_s=2.0e-3",
        "data.warm_up_s=1.0e-3", "data.n_cells=30", "parallel=serial", "law=1",
        "windows={n_windows: 4, periods: 1.0}", "map_points=2",
        "sustained.search={max_terms: 5, n_best: 100}", "sustained.depth=1",
    ]  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    toy_run = composed(*toy(tmp_path_factory.mktemp("outputs")), POINTS)
    return programs.computed(toy_run).folder


def test_the_run_leaves_a_law_tables_figures_and_a_summary(folder: Path) -> None:
    summary = summary_of(folder)
    law, headline = summary["law"], summary["headline"]
    names = {trial["fit"] for trial in summary["trials"]}
    (chosen,) = [trial for trial in summary["trials"] if trial["chosen"]]
    assert chosen["fit"] == law["fit"]
    assert law["cycle"] == "all"
    (exact,) = law["exact"]
    known, _, parameter = exact.removeprefix("n_n: 1 == ").partition(" * ")
    assert parameter == "mdot_mg_s"
    assert float(known) == pytest.approx(4.61e22, rel=0.05)
    assert chosen["functions"] == "1, V_D_V, mdot_mg_s"
    assert set(summary["models"]) == {
        *(f"point_{k}_{fit}" for k in range(4) for fit in (*names, "law"))
    }
    quiet = [p for p in summary["points"] if p["status"] != "oscillating"]
    assert [(p["V_D_V"], p["mdot_mg_s"]) for p in quiet] == [(150.0, 2.0)]
    tables = {path.stem: pd.read_csv(path) for path in (folder / "tables").glob("*.csv")}
    assert len(tables["left_out"]) == 4
    assert len(tables["map"]) == 4
    assert headline["n_sustained"] == (tables["left_out"]["status"] == "sustained").sum()
    assert headline["window_error"] == pytest.approx(chosen["error"])
    points = tables["points"]
    oscillating = points["status"] == "oscillating"
    assert headline["n_fitted_sustained"] == (points["law"][oscillating] == "sustained").sum()
    rates = tables["processes"].set_index(["process", "V_D_V", "mdot_mg_s"])
    assert {"neutrals that enter", "ions that leave"} <= set(rates.index.levels[0])
    supplied = rates["ratio"]["neutrals that enter"].to_numpy()
    np.testing.assert_allclose(supplied, 1.0, atol=0.02)
    alone = tables["coefficients"].set_index(["model", "state", "term"])["coef"]
    both = tables["law_coefficients"].set_index(["V_D_V", "mdot_mg_s", "state", "term"])
    at = (*points.loc[1, ["V_D_V", "mdot_mg_s"]], "n_i", "n_i")
    assert both["law"][at] == alone["point_1_law", "n_i", "n_i"]
    assert both["alone"][at] == alone[f"point_1_{law['fit']}", "n_i", "n_i"]


@pytest.mark.slow
def test_two_parts_give_the_law_of_one_run(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("EP2SINDY_CACHE", str(tmp_path / "kept"))
    monkeypatch.setattr(runner, "precompile", lambda: None)  # into the new cache
    given = [*toy(tmp_path), POINTS, "keep=true"]
    first, last = (run_config(composed(*given, f"parallel.part=[{k},2]")) for k in (2, 1))
    assert "part 2 of 2 is done, and its pieces are kept" in (first / "run.log").read_text()
    for name in ("law.json", "tables/coefficients.csv", "tables/left_out.csv", "tables/map.csv"):
        assert (last / name).read_bytes() == (folder / name).read_bytes()


def test_the_law_of_a_run_gives_models_in_python(folder: Path) -> None:
    law = OperatingLaw.load(folder / "law.json")
    assert law.parameters == ("V_D_V", "mdot_mg_s")
    model = law.at(V_D_V=310.0, mdot_mg_s=5.2)
    n_i, n_n = model.terms("n_i"), model.terms("n_n")
    exchanged = [term for term in n_i if term in n_n and "n_n" in term]
    assert [n_n[term] for term in exchanged] == [-n_i[term] for term in exchanged]
    assert n_n["1"] == pytest.approx(4.61e22 * 5.2, rel=0.05)
    with pytest.raises(ValueError, match="outside the points"):
        law.at(V_D_V=150.0, mdot_mg_s=2.0)


def test_ranges_of_points_are_every_combination_once() -> None:
    given = "{V_D_V: [280, 320.0], mdot_mg_s: [5, 6]}, {mdot_mg_s: [6.0, 7], V_D_V: 320}"
    sources = study_of(studied.Study, composed("law=1", f"points=[{given}]"))._given.sources
    found = [tuple(source.parameters.values()) for source in sources]
    assert found == [(280, 5), (280, 6), (320, 5), (320, 6), (320, 7)]
    again = "{V_D_V: 280, mdot_mg_s: 5, data: {duration_s: 1.0e-3}}"
    with pytest.raises(ValueError, match="once: V_D_V=280, mdot_mg_s=5 comes again"):
        study_of(studied.Study, composed("law=1", f"points=[{given}, {again}]"))


def test_a_map_encloses_the_points_and_has_two_parameters_at_most() -> None:
    corners = [{"a": 0.0, "b": 2.0}, {"a": 1.0, "b": 4.0}]
    grid = map_points(corners, 3)
    assert grid[0] == corners[0]
    assert grid[-1] == corners[1]
    assert len(grid) == 9
    assert map_points([{"a": 0.0, "b": 1.0, "c": 2.0}], 3) == []


def own_records(folder: Path, *values: float) -> list[str]:
    """Lienard's van der Pol over one parameter, in CSV files."""
    points = []
    for a in values:
        path = folder / f"{a}.csv"
        lienard(a).to_dataframe().to_csv(path, index_label="time")
        points.append(f"{{a: {a}, data: {{path: {path}}}}}")
    return [
        f"output={folder}", "data=file", "data.path=null", "data.z.name=null",
        "trajectory.zone.z=null", "data.variables.n_i.name=p", "data.variables.n_n.name=q",
        "~parameters.V_D_V", "~parameters.mdot_mg_s", "+parameters.a=null",
        f"points=[{','.join(points)}]", "sustained=none",
        "models={own: {terms: {n_i: [n_i,n_n,'n_i^3'], n_n: [n_i]}}}",
        "law=1", "windows={n_windows: 4, periods: 2.0}", "map_points=2", "parallel=serial",
    ]  # fmt: skip


def test_points_that_are_quiet_have_no_law(tmp_path: Path) -> None:
    damped = own_records(tmp_path, -0.6, -0.7, -0.8)
    with pytest.raises(ValueError, match=r"none of the 3 operating points oscillates \(decaying\)"):
        programs.computed(composed(*damped))


def test_own_records_make_a_law_of_the_model_that_is_chosen_and_its_line(tmp_path: Path) -> None:
    held = (
        "++models.held={terms: {n_i: [n_i,n_n,'n_i^3'], n_n: [n_i]}, known: {n_n: {n_i: {1: 1}}}}"
    )
    found = programs.computed(composed(*own_records(tmp_path, 0.6, 0.9, 1.2), held))
    table = found.report.tables["trials"]
    assert table["fit"][table["chosen"]].item().endswith("_refined")
    assert table["fit"].tolist() == ["own", "own_refined", "held", "held_refined"]
    assert table["numbers"].tolist() == [8, 8, 6, 6]
    law = OperatingLaw.load(found.folder / "law.json")
    np.testing.assert_allclose(law.at(a=1.0).terms("n_i")["n_i"], 1.0, atol=1e-3)
    assert set(found.report.figures) == {"laws", "map"}
    found.check_figures(*found.report.figures)
    assert found.report.headline["n_sustained"] == 3


def test_models_of_unlike_terms_are_scored_by_their_own_rows(tmp_path: Path) -> None:
    more = "++models.more={terms: {n_i: [n_i,n_n,'n_i^3'], n_n: ['1',n_i]}}"
    found = programs.computed(composed(*own_records(tmp_path, 0.6, 0.9, 1.2), more))
    fits = pd.read_csv(found.folder / "tables" / "fits.csv").groupby("fit")["r2_n_n"].min()
    assert fits.index.tolist() == ["more", "more_refined", "own", "own_refined"]
    assert fits["more"] == pytest.approx(fits["own"], abs=1e-3)


def test_without_a_model_the_terms_are_searched_for(tmp_path: Path) -> None:
    records = own_records(tmp_path, 0.6, 0.9, 1.2)
    found = programs.computed(composed(*records, "models=null", "++degree=3", "map_points=1"))
    names = [trial["fit"] for trial in found.summary["trials"]]
    assert names == ["found_1", "found_1_refined"]  # which follows the records, so that no other is
    terms = found.summary["models"]["point_0_law"]["equations"]
    # x' = y is the best of few terms, and of all.
    assert {state: set(own) for state, own in terms.items()} == {
        "n_i": {"n_i", "n_n", "n_i^3"}, "n_n": {"n_i"},
    }  # fmt: skip


def test_what_rests_is_counted_apart_and_what_went_out_is_not(tmp_path: Path) -> None:
    settings = own_records(tmp_path, 0.6, 0.9, 1.2, -0.4, 0.7)
    out = xr.Dataset.from_dataframe(pd.read_csv(tmp_path / "0.7.csv", index_col="time"))
    out["p"].attrs["units"] = out["q"].attrs["units"] = "m^-3"
    write_field(out.assign_attrs(status="out"), tmp_path / "out.nc")
    settings = [each.replace(f"{tmp_path}/0.7.csv", f"{tmp_path}/out.nc") for each in settings]
    found = programs.computed(composed(*settings))
    points = found.report.tables["points"].set_index("a")
    assert points["status"].tolist()[3:] == ["decaying", "out"]
    *held, rests = points["law"].tolist()[:4]
    assert all(word.startswith("follows the samples for") for word in held)
    assert rests == "rests"
    numbers = found.report.headline
    assert [numbers[f"n_{k}"] for k in ("points", "fitted_sustained", "rests")] == [5, 3, 1]
    says = "holds at 3 of the 3 it was fitted to, and rests at 1 of 1 whose record is quiet"
    assert f"{says}; not counted: out." in " ".join(found.log.split())


def test_a_search_that_fails_is_not_told_to_search(tmp_path: Path) -> None:
    records = own_records(tmp_path, 0.6, 0.9, 1.2)
    for path in tmp_path.glob("*.csv"):  # pulses, which no linear model has
        table = pd.read_csv(path, index_col="time")
        table.assign(p=table["p"] ** 3).to_csv(path)
    found = programs.computed(composed(*records, "models=null", "++degree=1"))
    (warning,) = [each for each in found.warnings if "of 3 points left out" in each]
    assert "or another ++degree=" in warning
    assert "models=null" not in warning
    assert "the law holds at 0 of 1 points left out" in found.log


def test_of_two_cycles_the_law_is_that_of_the_one_with_most_records(tmp_path: Path) -> None:
    values = (0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1)
    settings = own_records(tmp_path, *values)
    for a in values[2:4]:  # as if smaller cycles coexisted
        table = pd.read_csv(tmp_path / f"{a}.csv", index_col="time")
        (0.1 * table).to_csv(tmp_path / f"{a}.csv")
    found = programs.computed(composed(*settings))
    assert found.summary["law"]["cycle"] == "strong"
    (warning,) = [each for each in found.warnings if "two cycles coexist" in each]
    assert warning.endswith("a=0.7, a=0.8")
    points = found.report.tables["points"].set_index("a")["branch"]
    assert points.to_dict() == {a: "weak" if a in values[2:4] else "strong" for a in values}
    law = OperatingLaw.load(found.folder / "law.json")
    assert law.points[:, 0].tolist() == [0.5, 0.6, 0.9, 1.0, 1.1]


def known_records(folder: Path, system: str) -> list[str]:
    """The records of a known law in CSV files, and how a study reads them."""
    for run in known_laws.records(system, noise=0.05, seed=0):
        name = "_".join(f"{key}{value:.6g}" for key, value in run.parameters.items())
        run.to_dataframe().to_csv(folder / f"{name}.csv", index_label="time (s)")
    law = known_laws.LAWS[system]
    pattern = "_".join(f"{key}{{{key}}}" for key in known_laws.POINTS[system][0])
    terms = ", ".join(
        f"{state}: [{', '.join(repr(term) for term in own)}]" for state, own in law.items()
    )
    return [
        "data=recognised", "data.path=null", f"points.files='{folder}/{pattern}.csv'",
        f"trajectory.states=[{','.join(law)}]", "trajectory.zone=null",
        f"++models={{own: {{terms: {{{terms}}}}}}}", f"output={folder}/outputs",
        "parallel=serial", "keep=false",
    ]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("system", known_laws.LAWS)
@pytest.mark.parametrize("experiment", ["parametric", "predict"])
def test_the_law_of_known_records_is_headlined(
    experiment: str, system: str, tmp_path: Path
) -> None:
    own = {"parametric": ["~models", "thesis=null"], "predict": ["map_points=2", "sustained=none"]}
    settings = [*own[experiment], *known_records(tmp_path, system)]
    found = programs.computed(programs.composed(f"+exp={experiment}", *settings))
    summary = found.summary["law"]
    # Rows have the bias of smoothing: the refined coefficients are right.
    assert summary["fit"] == "own_refined"
    law = OperatingLaw.load(found.folder / "law.json")
    left_out = law.left_out[law.left_out < 1.0]  # of refinements that converged
    assert len(left_out) >= 11
    assert left_out.max() < 0.01
    missed = []
    for at in known_laws.POINTS[system]:
        true, own = (each.at(extrapolate=True, **at) for each in (known_laws.truth(system), law))
        missed += [
            own.terms(state)[term] / value - 1.0
            for state in true.states
            for term, value in true.terms(state).items()
        ]
    assert np.sqrt(np.square(missed).mean()) < 0.01


def test_breathing_over_points_is_this_study(tmp_path: Path) -> None:
    """Of files with foreign names; the inflow is stated as a function of the point."""
    values = (0.95, 0.96, 0.97, 0.98)
    for a in values:
        run = breathing_at(a)
        table = run.to_dataframe().set_axis(["<ne> [m^-3]", "<nn> [m^-3]"], axis=1)
        table.to_csv(tmp_path / f"a{a}.csv", index_label="t [s]")
    found = programs.computed(
        programs.composed(
            "+exp=breathing", "data=recognised", "data.path=null",
            f"points.files='{tmp_path}/a{{a}}.csv'", "sustained.roles.inflow.n_n={a: 1.0e18}",
            "sustained.search={max_terms: 4, n_best: 100}", "sustained.depth=2",
            "parallel=serial", f"output={tmp_path}",
        )
    )  # fmt: skip
    law = OperatingLaw.load(found.folder / "law.json")
    assert found.report.headline["n_fitted_sustained"] == 4
    assert law.at(a=0.965).terms("n_n")["1"] == pytest.approx(0.965e18)
    processes = found.report.tables["processes"]
    assert set(processes["a"]) == {*values}
    supplied = processes[processes["process"] == "neutrals that enter"]
    np.testing.assert_allclose(supplied["modelled"], 1e18 * supplied["a"])
    found.check_figures("laws", "map", "processes")
    assert (
        "Find one structure for all operating points" in (found.folder / "report.html").read_text()
    )


def breathing_at(a: float) -> ep.Trajectory:
    """Ions that leave, ionization that rises with them, and an inflow in proportion to a."""
    library, size = ep.polynomial(["n_i", "n_n"], degree=3), 1e18
    born = {"n_i^2*n_n": 1.0 / size**2}
    lost = {"n_n": -0.02, "n_i^2*n_n": -1.0 / size**2}
    coef = ep.model.coef_matrix(library, [{"n_i": -1.0, **born}, {"1": size * a, **lost}])
    model = ep.SparseModel(library, ["n_i", "n_n"], coef, {"n_i": "m^-3", "n_n": "m^-3"})
    t = 0.1 * np.arange(4000)
    states = model.simulate(t, [0.9 * size, size]).states
    return ep.Trajectory(t, states, ["n_i", "n_n"], units=model.units).window(2000, 4000)


def test_a_law_of_one_signal_rests_where_it_is_noise_on_a_large_mean(tmp_path: Path) -> None:
    """A tube whose sound is small next to the pressure: silent at two powers, loud at four."""
    rng = np.random.default_rng(0)
    for a in (-0.4, -0.2, 0.2, 0.4, 0.6, 0.8):
        x = lienard(a).states[:, 0] if a > 0.0 else np.zeros(lienard(1.0).n_samples)
        noisy = 60.0 + x + 0.02 * rng.normal(size=len(x))
        table = pd.DataFrame({"t [s]": lienard(1.0).t, "p [Pa]": noisy})
        table.to_csv(tmp_path / f"a{a}.csv", index=False)
    found = programs.computed(
        composed(
            "data=recognised", "data.path=null", f"points.files='{tmp_path}/a{{a}}.csv'",
            "trajectory.states=[p]", "map_points=2", "parallel=serial", f"output={tmp_path}",
        )
    )  # fmt: skip
    points = found.report.tables["points"].set_index("a")
    assert points["status"].tolist() == ["steady"] * 2 + ["oscillating"] * 4
    assert points["law"].tolist()[:2] == ["rests"] * 2
    assert found.report.headline["n_rests"] == found.report.headline["n_quiet"] == 2
    assert found.report.headline["n_fitted_sustained"] == 4
