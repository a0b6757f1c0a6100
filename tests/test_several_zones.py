"""Several zones in one trajectory: averages, names, roles by neighbourhood, and balances."""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import ep2sindy as ep
from ep2sindy.data.zones import ZoneAverage, side_by_side
from ep2sindy.library.equations import latex_derivative, latex_name, latex_term_name
from ep2sindy.library.names import check_state
from ep2sindy.library.relations import parse_relation
from ep2sindy.library.roles import constraint_of, process_matrix
from ep2sindy.studies.processes import Zones, compared_processes, fit_roles
from tests.models import model_of
from tests.programs import composed, computed

STATES = ["n_i", "n_n"]
ROLES = ep.Roles(exchange=[("n_n", "n_i")], outflow=STATES, inflow={"n_n": 0.4})
SIZES = {"a": 2.0, "b": 4.0}
NAMES = ["n_i@a", "n_n@a", "n_i@b", "n_n@b"]


@pytest.fixture(scope="module")
def field() -> xr.Dataset:
    return ep.thruster.simulate(
        ep.thruster.Thruster(), ep.thruster.OperatingPoint(300.0, 5.0), n_cells=40,
        duration_s=6e-4, warm_up_s=2e-4, progress=False,
    )  # fmt: skip


@pytest.fixture(scope="module")
def zones(field: xr.Dataset) -> dict[str, tuple[float, float]]:
    return {"anode": (0.0, 0.01), "exit": (0.01, 0.025)}


@pytest.fixture(scope="module")
def run(field: xr.Dataset, zones: dict[str, tuple[float, float]]) -> ep.Trajectory:
    return ep.zone_averages(field, zones, states=STATES, label="two")


def test_every_zone_has_its_own_average(field, zones, run) -> None:
    assert run.state_names == ("n_i@anode", "n_n@anode", "n_i@exit", "n_n@exit")
    assert set(run.units.values()) == {"m^-3"}
    for k, z in enumerate(zones.values()):
        alone = ep.zone_average(field, ep.Zone(z=z), states=STATES)
        assert np.array_equal(run.states[:, 2 * k : 2 * k + 2], alone.states)


def test_the_averages_of_all_zones_make_that_of_the_channel(field, zones, run) -> None:
    sizes = ZoneAverage(STATES, zones=zones).sizes(field)
    whole = ep.zone_average(field, ep.Zone(z="channel"), states=STATES)
    fraction = np.array([*sizes.values()]) / sum(sizes.values())
    assert fraction @ run.states[:, ::2].T == pytest.approx(whole.states[:, 0], rel=1e-6)


def test_a_grid_point_on_a_shared_edge_belongs_to_the_first_zone() -> None:
    data = {"n": (("time", "z"), np.outer(np.arange(1.0, 6.0), np.arange(5.0)), {"units": "m^-3"})}
    field = xr.Dataset(data, coords={"time": np.arange(5.0), "z": 0.01 * np.arange(5.0)})
    run = ep.zone_averages(field, {"a": (0.0, 0.02), "b": (0.02, 0.04)}, states=["n"])
    assert run.states[0].tolist() == pytest.approx([1.0, 3.5])  # 0, 1, 2 and 3, 4


def test_inputs_and_products_are_averaged_in_every_zone(field, zones) -> None:
    run = ep.zone_averages(field, zones, states=["n_i"], inputs=["R_ion"], products=["n_i*n_n"])
    assert run.input_names == ("R_ion@anode", "<n_i*n_n>@anode", "R_ion@exit", "<n_i*n_n>@exit")
    settings = ZoneAverage(["n_i"], zones=zones)
    assert settings.columns(["R_ion"]) == ["R_ion@anode", "R_ion@exit"]
    assert "anode: average over z 0 to 10 mm" in settings.place(field)


@pytest.mark.parametrize(
    ("zones", "message"),
    [
        ({"a": (0.0, 0.015), "b": (0.01, 0.02)}, "without overlap.*after one that ends at 0.015"),
        ({"a": ep.Zone()}, "each with its ends in m"),
    ],
)
def test_zones_that_make_no_sense_are_refused(field, zones, message) -> None:
    with pytest.raises(ValueError, match=message):
        ep.zone_averages(field, zones, states=STATES)


def test_a_number_cuts_the_zone_into_equal_parts(field) -> None:
    settings = ZoneAverage(STATES, ep.Zone(z="channel"), zones=2)
    parts = settings.parts(field)
    assert [part.z for part in parts.values()] == [(0.0, 0.0125), (0.0125, 0.025)]
    assert settings.columns(["n_i"]) == ["n_i@z1", "n_i@z2"]
    assert settings.trajectory(field, inputs=[], label="").state_names[-1] == "n_n@z2"
    whole = ZoneAverage(STATES, zones=3).parts(field)
    assert whole["z3"].z[1] > field["z"].values[-1]


@pytest.mark.parametrize("zones", [0, "two"])
def test_zones_are_a_number_or_have_names(zones) -> None:
    with pytest.raises(ValueError, match="whole number of parts, one or more, or zones by name"):
        ZoneAverage(STATES, zones=zones)


def test_zones_that_exchange_must_adjoin(field) -> None:
    apart = ZoneAverage(STATES, zones={"a": (0.0, 0.01), "b": (0.015, 0.025)})
    assert len(apart.trajectory(field, inputs=[], label="").state_names) == 4
    with pytest.raises(ValueError, match="must adjoin"):
        apart.sizes(field)


def test_a_zone_is_part_of_a_name_in_every_notation() -> None:
    check_state("n_i@exit")
    for wrong in ("n_i@", "@exit", "n_i@a@b", "n i@a"):
        with pytest.raises(ValueError, match="must be a word"):
            check_state(wrong)
    assert latex_derivative("n_i@exit") == r"\dot{n}_{i,exit}"
    assert latex_term_name("x@a*<n_i*n_n>@b") == r"x_{a} \, \langle n_{i} \, n_{n} \rangle_{b}"
    assert latex_name("n_i@exit") == "n_{i,exit}"
    library = ep.polynomial(NAMES, degree=2)
    assert library.names[library.index("n_n@b*n_i@a")] == "n_i@a*n_n@b"
    relation = parse_relation("n_i@a: n_i@a*n_n@a == -1 * n_n@a: n_i@a*n_n@a")
    assert [state for _, state, _ in relation.factors] == ["n_i@a", "n_n@a"]


def test_roles_in_zones_are_those_of_neighbours() -> None:
    roles = ROLES.in_zones(SIZES)
    library = ep.polynomial(NAMES, degree=3)
    found: dict[str, list] = {}
    for process in roles.processes(library, NAMES):
        found.setdefault(process.role, []).append(process)
    assert list(found) == [
        "n_n@a to n_i@a", "n_n@b to n_i@b", "n_n@a to n_n@b", "n_i@a to n_i@b", "n_i@b out",
        "n_n@b out",
    ]  # fmt: skip
    assert [p.term for p in found["n_n@a to n_i@a"]] == [
        "n_i@a*n_n@a", "n_i@a*n_n@a^2", "n_i@a^2*n_n@a", "n_i@a*n_n@a*n_n@b"
    ]  # fmt: skip
    assert [p.term for p in found["n_n@a to n_n@b"]] == [
        "n_n@a", "n_n@a^2", "n_i@a*n_n@a", "n_n@a*n_n@b"
    ]  # fmt: skip
    moved = found["n_n@a to n_n@b"][0]
    assert moved.factors == {("n_n@a", "n_n@a"): -1.0, ("n_n@b", "n_n@a"): 0.5}
    assert roles.inflow == {"n_n@a": pytest.approx(1.2)}  # 0.4 of three parts enters one


def test_a_chain_of_three_zones_has_two_neighbours_in_the_middle() -> None:
    roles = ROLES.in_zones({"a": 1.0, "b": 1.0, "c": 1.0})
    near = {taker: terms[3:] for giver, taker, terms in roles.exchange[:3]}
    assert near == {
        "n_i@a": ["n_n@a*n_i@a*n_n@b"],
        "n_i@b": ["n_n@b*n_i@b*n_n@a", "n_n@b*n_i@b*n_n@c"],
        "n_i@c": ["n_n@c*n_i@c*n_n@b"],
    }
    assert not any("a" in giver[-1] and "c" in taker[-1] for giver, taker, _ in roles.exchange)


# Two vessels, b twice as large: what leaves a by N or G enters b, and leaves it again.
R, F, G, OUT, P = 1.0, 0.6, 0.5, 0.8, 0.1
CHAIN = {
    "n_i@a": {"n_i@a": -F, "n_i@a*n_n@a": R},
    "n_n@a": {"1": 1.2, "n_n@a": -G, "n_i@a*n_n@a": -R},
    "n_i@b": {"n_i@a": F / 2, "n_i@b": -OUT, "n_i@b*n_n@b": R},
    "n_n@b": {"n_n@a": G / 2, "n_n@b": -P, "n_i@b*n_n@b": -R},
}


def chain() -> ep.Trajectory:
    t = np.linspace(0.0, 30.0, 601)
    states = model_of(CHAIN).simulate(t, [0.1, 2.0, 1.5, 0.2]).states
    return ep.Trajectory(t, states, NAMES, units=dict.fromkeys(NAMES, "m^-3"))


def refined(depth: int) -> ep.Regression:
    """A search whose systems are refined and assessed whole."""
    search = ep.BestSubset(max_terms=6, n_best=100)
    return ep.Regression(search=search, selection=ep.FreeRunScore(bounds=None), depth=depth)


def test_a_search_in_zones_finds_the_truth_and_conserves() -> None:
    library = ep.polynomial(NAMES, degree=3)
    found = ep.discover(chain(), library.with_roles(ROLES.in_zones(SIZES)), refined(depth=4))
    for state, terms in CHAIN.items():
        assert found.model.terms(state) == pytest.approx(terms, rel=2e-3)
    ours, theirs = (found.model.terms(s)["n_i@a"] for s in ("n_i@a", "n_i@b"))
    assert theirs == -ours / 2  # exactly, by the sizes
    assert {p.role for p in found.constraint.processes} == {
        p.role for p in ROLES.in_zones(SIZES).processes(library, NAMES)
    }


def test_processes_of_zones_stand_next_to_what_the_record_exchanged(field, zones, run) -> None:
    """A model of made-up rates: each process has the rate of its own terms, and its record."""
    parts = side_by_side(zones, field)
    balances = {name: ep.thruster.zone_balance(field, zone) for name, zone in parts.items()}
    sizes = ZoneAverage(STATES, zones=zones).sizes(field)
    roles = ROLES.in_zones(sizes).with_known(
        {k: dict(v.terms) for k, v in fit_roles(balances, run).items()}
    )
    library = ep.polynomial(run.state_names, degree=3)
    chosen = {p.role: p for p in roles.processes(library, run.state_names)}  # the last of each
    held = constraint_of(library, run.state_names, [*chosen.values()], roles.known_processes)
    assert held is not None
    rates = 1e23 * np.arange(1.0, 7.0)
    theta = library.evaluate(run.states)
    means = [theta[:, library.index(p.term)].mean() for p in chosen.values()]
    values = held.coef(process_matrix(held) @ (rates / means))
    coef = np.zeros((len(library), 4))
    for (state, term), value in zip(held.coefficients, values, strict=True):
        coef[library.index(term), run.state_names.index(state)] = value
    model = ep.SparseModel(library, run.state_names, coef, run.units)
    found = {p.name: p for p in compared_processes(model, held, run, Zones(balances, sizes))}
    assert [p.modelled.mean() for p in found.values()][1:] == pytest.approx(rates)
    whole = ep.thruster.zone_balance(field, ep.Zone(z="channel"))
    fraction = sum(sizes.values()) / sizes["exit"]
    for name, term in (("ions that leave", "exit_i"), ("neutrals that leave", "exit_n")):
        assert found[name].recorded == pytest.approx(fraction * whole[term].values, rel=1e-3)
    inner = balances["anode"]["exit_n"].values
    assert found["neutrals from anode to exit"].recorded == pytest.approx(inner)
    assert found["neutrals that enter"].recorded.mean() == pytest.approx(
        float(whole["supply"].mean()) * sum(sizes.values()) / sizes["anode"], rel=1e-3
    )
    made = balances["exit"]["ionization"].values - balances["exit"]["returned"].values
    name = "exit: neutrals that become ions, less those given back"
    assert np.array_equal(found[name].recorded, made)
    beside = model_record(found, balances, sizes)
    for process in compared_processes(model, held, run, Zones(beside, sizes)):
        assert process.counterpart == pytest.approx(dict(process.coef), rel=1e-6)


def model_record(found, balances, sizes) -> dict[str, xr.Dataset]:
    """Balances of the zones `anode` and `exit` in which every process is the model's own."""
    rate = {each.ends: each.modelled for each in found.values()}
    fraction, made = sizes["anode"] / sizes["exit"], {}
    for zone, balance in balances.items():
        exchanged = rate[f"n_n@{zone}", f"n_i@{zone}"]
        made[zone] = balance.assign(ionization=balance["returned"] + exchanged)
        for state, key in (("n_i", "exit_i"), ("n_n", "exit_n")):
            gone = rate[f"{state}@anode", f"{state}@exit"]
            if zone == "exit":
                gone = rate[f"{state}@exit", ""] - fraction * gone
            made[zone][key] = ("time", gone)
    made["anode"]["supply"] = ("time", rate["", "n_n@anode"])
    return made


def toy(output: Path) -> list[str]:
    """Overrides that run `+exp=zones` on a file of the chain, which is written next to its runs."""
    record = chain()
    z = np.array([0.0025, 0.0075, 0.0125, 0.0175, 0.0225, 0.0275])
    density = {
        name: (("time", "z"), 1e18 * record.columns([f"{name}@{k}" for k in "aabbbb"]))
        for name in STATES
    }
    field = xr.Dataset(density, coords={"time": 1e-6 * record.t, "z": z})
    for name, unit in (("n_i", "m^-3"), ("n_n", "m^-3"), ("time", "s"), ("z", "m")):
        field[name].attrs["units"] = unit
    ep.data.write_field(field, output / "chain.nc")
    return [
        "+exp=zones", "data=file", f"data.path={output}/chain.nc", f"output={output}",
        "trajectory.zones={a: [0.0, 0.01], b: [0.01, 0.03]}", "data.z.name=z", "bootstraps.n=4",
        "sustained.search.max_terms=7", "sustained.depth=2", "rollout_s=null",
    ]  # fmt: skip


def test_the_experiment_reports_zones_and_their_processes(tmp_path: Path) -> None:
    record = chain()
    found = computed(composed(*toy(tmp_path)))
    assert found.summary["data"]["variables"] == NAMES
    sustained = found.summary["models"]["zones_sustained"]["equations"]
    taken = sustained["n_i@a"]["n_i@a"]
    assert sustained["n_i@b"]["n_i@a"] == pytest.approx(-taken / 2, rel=1e-6)
    assert sustained["n_n@a"]["1"] == pytest.approx(1.2e24, rel=0.01)  # free in a file
    processes = {each["process"]: each for each in found.summary["balance_zones"]}
    assert {each["recorded"] for each in processes.values()} == {None}  # densities alone
    assert processes["neutrals from a to b"]["modelled"] == pytest.approx(
        G * 1e24 * record.states[:, 1].mean(), rel=0.01
    )
    terms = [(each["part"], each["term"]) for each in found.summary["terms_zones"]]
    assert ("ions from a to b", "n_i@a") in terms
    assert "<mi>i</mi><mo>,</mo><mi>a</mi>" in found.page  # n with the index i,a
