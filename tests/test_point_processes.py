"""Processes over operating points: rates by a law, their errors, next to what records tell."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from omegaconf import OmegaConf

import ep2sindy as ep
from ep2sindy.app.runner import start_run
from ep2sindy.library.roles import process_matrix
from ep2sindy.operating.law import constrain_roles
from ep2sindy.operating.left_out import LawChoice, LawTrial
from ep2sindy.operating.point_fits import PointFits
from ep2sindy.operating.records import OperatingRecord
from ep2sindy.report.document import Table
from ep2sindy.report.report import Report
from ep2sindy.studies.point_processes import add_processes, point_processes
from ep2sindy.studies.processes import Zones

SUPPLY = {"n_n": {"V": 0.01}}
ROLES = ep.Roles(exchange=[("n_n", "n_i")], outflow=["n_i", "n_n"], inflow=SUPPLY, nonnegative=True)
TERMS = {"n_n to n_i": "n_i*n_n", "n_i out": "n_i", "n_n out": "n_n"}
LINE = [{"V": v} for v in (200.0, 250.0, 300.0, 400.0)]
GRID = [{"V": v, "m": m} for m in (4.0, 5.0) for v in np.linspace(200.0, 400.0, 9).tolist()]
ENTER, LEAVE = "neutrals that enter", "ions that leave"
IONIZED = "neutrals that become ions, less those that walls and anode give back"


def choice_of(
    points: list[dict[str, float]], roles: ep.Roles = ROLES, terms: dict[str, str] = TERMS
) -> LawChoice:
    """A law of degree one, of fits that no law meets exactly; the records need obey no equations.

    terms: of each role's process.
    """
    states = tuple(sorted({state for role in terms for state in role.split()[::2]}))
    library = ep.polynomial(states, degree=2)
    free = replace(roles, inflow={}).processes(library, states)
    chosen = [process for process in free if terms.get(process.role) == process.term]
    held = constrain_roles(library, states, chosen, roles, parameters=list(points[0]))
    values = np.array([[*point.values()] for point in points])
    units, rng = dict.fromkeys(states, "m^-3"), np.random.default_rng(0)
    models, records = [], []
    for point, at in zip(points, held.at(values), strict=True):
        amounts = 0.01 * point["V"] + rng.uniform(1.0, 1.2, size=len(chosen))
        equations = at.equations(process_matrix(at) @ amounts)
        coef = ep.model.coef_matrix(library, [equations[state] for state in states])
        models.append(ep.SparseModel(library, states, coef, units))
        samples = rng.uniform(1.0, 2.0, size=(50, len(states)))
        run = ep.Trajectory(np.arange(50.0), samples, states, parameters=point, units=units)
        records.append(OperatingRecord(run))
    information = np.tile(np.eye(len(chosen)), (len(points), 1, 1))
    fits = PointFits(tuple(points[0]), values, held, models, information, "rows")
    trial = LawTrial("found", fits, ep.polynomial(list(points[0]), degree=1), records)
    return LawChoice([trial], trial, [])


def test_rates_are_those_of_the_laws_terms_at_every_record() -> None:
    choice = choice_of(LINE)
    found = point_processes(choice, {})
    names = [each.process.name for each in found[:4]]
    assert names == [ENTER, IONIZED, LEAVE, "neutrals that leave"]
    assert len(found) == 16
    for each in found:
        n_i, n_n = each.record.run.columns(["n_i", "n_n"]).T
        own = choice.law.at(**each.record.parameters).terms("n_i")
        known = {
            ENTER: 0.01 * each.record.parameters["V"],
            LEAVE: -own["n_i"] * n_i.mean(),
            IONIZED: own["n_i*n_n"] * (n_i * n_n).mean(),
        }
        if each.process.name in known:
            assert each.modelled == pytest.approx(known[each.process.name])
        assert np.isnan([each.recorded, each.process.ratio]).all()


def test_the_error_of_a_rate_is_the_jackknifes_and_what_is_known_has_none() -> None:
    choice = choice_of(LINE)
    fits, functions = choice.choice.fits, choice.choice.functions
    for each in point_processes(choice, {}):
        if each.process.name == ENTER:
            assert each.reach == 0.0
            continue
        (term,) = each.process.coef
        run, state = each.record.run, each.process.ends[0]
        mean = fits.models[0].library.evaluate(run.states).mean(axis=0)
        without = [
            law.at(extrapolate=True, **each.record.parameters).terms(state)[term]
            * -mean[fits.models[0].library.index(term)]
            for law in (fits.law_without(k, functions) for k in range(4))
        ]
        assert each.process.std == pytest.approx(np.sqrt(3.0) * np.std(without))
        own = [record.label for record in choice.records].index(each.record.label)
        assert each.left_out == pytest.approx(without[own])


def test_a_law_that_leaves_no_point_over_has_rates_without_errors() -> None:
    for each in point_processes(choice_of(LINE[:2]), {}):
        assert np.isfinite(each.modelled)
        assert np.isnan([each.reach, each.left_out]).all()


def told(choice: LawChoice) -> dict[str, Zones]:
    """The first record tells that half as many ions leave as by the law, sample by sample."""
    leaving = {e.record.label: e.process for e in point_processes(choice, {})
               if e.process.name == LEAVE}  # fmt: skip
    label, run = choice.records[0].label, choice.records[0].run
    balance = xr.Dataset({"exit_i": ("time", 0.5 * leaving[label].modelled)}, {"time": run.t})
    return {label: Zones({"": balance}), choice.records[1].label: Zones({}, {"": 1.0})}


def test_a_rate_stands_next_to_that_of_the_records_that_tell_it() -> None:
    choice = choice_of(LINE)
    found = point_processes(choice, told(choice))
    known = [(each.record.label, each.process.name) for each in found if each.recorded > 0.0]
    assert known == [("V=200", LEAVE)]
    assert found[2].process.ratio == pytest.approx(2.0)


def test_other_states_have_the_names_of_their_roles_and_no_record_tells_them() -> None:
    roles = ep.Roles(exchange=[("prey", "fox")], outflow=["fox"], inflow={"prey": 2.0})
    choice = choice_of(LINE, roles, {"prey to fox": "fox*prey", "fox out": "fox"})
    balance = {"returned": ("time", np.ones(50))}
    zones = {r.label: Zones({"": xr.Dataset(balance, {"time": r.run.t})}) for r in choice.records}
    found = point_processes(choice, zones)
    assert [each.process.name for each in found[:3]] == ["prey in", "prey to fox", "fox out"]
    assert np.isnan([each.recorded for each in found]).all()


def test_terms_of_a_state_without_roles_are_no_processes() -> None:
    roles = ep.Roles(outflow=["fox"], inflow={"fox": 1.0})
    choice = choice_of(LINE, roles, {"fox out": "fox", "prey free": "prey"})
    assert {each.process.name for each in point_processes(choice, {})} == {"fox in", "fox out"}


@pytest.fixture
def report(tmp_path: Path) -> Report:
    settings = {"experiment": "toy", "seed": 3, "output": str(tmp_path)}
    with start_run(OmegaConf.create(settings)) as report:
        return report


def tables(report: Report) -> list[Table]:
    return [each for each in report.sections[-1].blocks if isinstance(each, Table)]


def test_a_table_has_a_row_for_each_process_and_a_column_for_each_point(report: Report) -> None:
    choice = choice_of(LINE)
    add_processes(report, choice, told(choice), {})
    seen, every = tables(report)
    assert list(seen.rows) == ["process", "V=200", "V=250", "V=300", "V=400"]
    assert seen.title == "in m^-3 s^-1"
    assert seen.rows["V=200"].iloc[0] == "2.00"  # known
    assert seen.rows["V=200"].iloc[2].endswith("(2.00)")
    assert "±" in seen.rows["V=200"].iloc[2]
    assert "differ from those recorded by" in seen.note
    assert len(every.rows) == len(report.tables["processes"]) == 16
    assert every.page_only


def test_of_many_points_the_longest_line_is_shown(report: Report) -> None:
    choice = choice_of(GRID, replace(ROLES, inflow={"n_n": 3e22}))
    add_processes(report, choice, {}, {})
    seen = tables(report)[0]
    assert list(seen.rows)[1::7] == ["V=200", "V=400"]
    assert len(seen.rows.columns) == 1 + 8
    assert seen.title == "in 10^22 m^-3 s^-1, at m=4"
    assert seen.rows["V=400"].iloc[0] == "3.00"
    assert len(report.tables["processes"]) == 4 * 18


def test_the_figure_has_marks_of_law_and_record_at_their_points(report: Report) -> None:
    choice = choice_of(LINE)
    add_processes(report, choice, told(choice), {"V": "voltage (V)"})
    figure = report.figures["processes"].draw()
    figure.draw_without_rendering()
    titles = [ax.get_title().replace("\n", " ") for ax in figure.axes]
    assert titles == [ENTER, IONIZED, LEAVE, "neutrals that leave"]
    assert {ax.get_xlabel() for ax in figure.axes} == {"voltage (V)"}
    law, record = (marks.lines[0] for marks in figure.axes[2].containers)
    table: pd.DataFrame = report.tables["processes"]
    own = table[table["process"] == LEAVE]
    np.testing.assert_allclose(law.get_xydata(), own[["V", "modelled"]])
    np.testing.assert_allclose(record.get_xydata(), own[["V", "recorded"]].iloc[:1])
    assert all(ax.get_ylim()[0] <= 0.0 for ax in figure.axes)


def test_a_law_without_roles_has_no_processes(report: Report) -> None:
    choice = choice_of(LINE)
    fits = choice.choice.fits
    common = replace(fits.relations.common, processes=(), known=())
    free = replace(
        choice.choice, fits=replace(fits, relations=replace(fits.relations, common=common))
    )
    add_processes(report, replace(choice, choice=free), {}, {})
    assert "processes" not in report.tables
