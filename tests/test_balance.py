"""Balance of a zone: exact from averages, estimated from fields, and next to a model."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

import ep2sindy as ep
from ep2sindy.library.roles import constraint_of, sum_known
from ep2sindy.studies.processes import Zones, compared_processes, fit_roles
from ep2sindy.studies.sustained import model_balance
from tests.thrusters import brief

STATES = ["n_i", "n_n"]
CHANNEL = ep.Zone(z="channel")


@pytest.fixture(scope="module")
def field() -> xr.Dataset:
    return brief(duration_s=6e-4, warm_up_s=2e-4)


@pytest.fixture(scope="module")
def exact(field: xr.Dataset) -> xr.Dataset:
    return ep.thruster.zone_balance(field, CHANNEL)


def test_the_balance_of_the_whole_channel_closes_term_by_term(exact: xr.Dataset) -> None:
    ions = exact["change_i"] - exact["ionization"] + exact["exit_i"] + exact["returned"]
    neutrals = (
        exact["change_n"] + exact["ionization"] + exact["exit_n"] - exact["returned"]
        - exact["supply"]
    )  # fmt: skip
    largest = float(np.abs(exact["ionization"]).max())
    assert float(np.abs(ions).max()) < 1e-6 * largest  # float32 fields
    assert float(np.abs(neutrals).max()) < 1e-6 * largest


def test_continuity_closes_in_every_cell_with_gradients_by_faces(field: xr.Dataset) -> None:
    ions = ep.data.gradient(field, of="n_i*u_iz", name="div")
    neutrals = ep.data.gradient(field, of="face_flux_n", name="div")
    born = field["ionization"] - field["wall_loss"]
    for density, side, sign in (("n_i", ions, 1.0), ("n_n", neutrals, -1.0)):
        left = field[f"d{density}_dt"] - sign * born + side["div"]
        assert float(np.abs(left).isel(z=slice(-1)).max()) < 2e-5 * float(born.max())  # float32


def test_the_supply_is_the_mass_flow(field: xr.Dataset, exact: xr.Dataset) -> None:
    thruster = ep.thruster.Thruster()
    particles = 1e-6 * 5.0 / (thruster.propellant.mass * thruster.area)
    assert field.attrs["neutral_inflow"] == pytest.approx(particles)
    length_m = float(field["dz"].values[field["z"].values <= 0.025].sum())
    assert exact["supply"].values == pytest.approx(particles / length_m, rel=1e-5)
    found = fit_roles({"": exact}, ep.zone_average(field, CHANNEL, states=STATES))
    assert found["n_n in"].terms == {"1": pytest.approx(particles / length_m, rel=1e-5)}


def test_what_leaves_and_comes_back_is_fitted_by_least_squares(exact: xr.Dataset, data) -> None:
    """A balance that is made of the terms themselves gives their coefficients."""
    n_i, n_n = data.states.T
    made = exact.assign(
        exit_n=("time", 3e3 * n_n + 2e-16 * n_i * n_n), returned=("time", 1e5 * n_i)
    )
    found = fit_roles({"": made}, data)
    assert found["n_n out"].terms == pytest.approx({"n_n": 3e3, "n_i*n_n": 2e-16}, rel=1e-6)
    assert found["n_i to n_n"].terms == pytest.approx({"n_i": 1e5}, rel=1e-6)
    assert found["n_n out"].r2 == pytest.approx(1.0)
    half = fit_roles({"": made}, data.window(0, data.n_samples // 2))
    assert half["n_i to n_n"].terms == pytest.approx({"n_i": 1e5}, rel=1e-6)


def test_a_field_without_averages_gives_nearly_the_same(field: xr.Dataset, exact: xr.Dataset):
    plain = field[["n_i", "n_n", "R_ion", "u_iz"]]
    found = ep.thruster.zone_balance(plain, CHANNEL)
    assert set(found) == {"change_i", "change_n", "ionization", "exit_i", "returned", "exit_n",
                          "supply"}  # fmt: skip
    for name, fraction in (("ionization", 0.02), ("supply", 0.01), ("exit_i", 0.05)):
        assert float(found[name].mean()) == pytest.approx(float(exact[name].mean()), rel=fraction)


def test_a_file_gives_what_it_can(field: xr.Dataset) -> None:
    plain = field[["n_i", "n_n"]].assign_attrs(neutral_inflow=0.0)
    del plain.attrs["neutral_inflow"]
    assert set(ep.thruster.zone_balance(plain, CHANNEL)) == {"change_i", "change_n"}
    flat = plain.mean("z")
    flat = flat.assign({name: flat[name].assign_attrs(plain[name].attrs) for name in STATES})
    assert set(ep.thruster.zone_balance(flat, ep.Zone())) == {"change_i", "change_n"}
    downstream = ep.thruster.zone_balance(field, ep.Zone(z="downstream"))
    assert "supply" not in downstream  # what enters through an inner face is not known beforehand
    run = ep.zone_average(field, ep.Zone(z="downstream"), states=STATES)
    assert "n_n in" not in fit_roles({"": downstream}, run)


@pytest.fixture(scope="module")
def data(field: xr.Dataset) -> ep.Trajectory:
    return ep.zone_average(field, CHANNEL, states=STATES)


def model_of(ions: dict[str, float], neutrals: dict[str, float]) -> ep.SparseModel:
    library = ep.polynomial(STATES, degree=2)
    coef = ep.model.coef_matrix(library, [ions, neutrals])
    return ep.SparseModel(library, STATES, coef, dict.fromkeys(STATES, "m^-3"))


def under(roles: ep.Roles, values: dict[tuple[str, str], float]):
    """The model whose processes have these coefficients, by role and term, and its constraint."""
    library = ep.polynomial(STATES, degree=2)
    chosen = [p for p in roles.processes(library, STATES) if (p.role, p.term) in values]
    held_to = constraint_of(library, STATES, chosen, roles.known_processes)
    assert held_to is not None
    known = sum_known(roles.known_processes)
    coef = np.array([known.get(at, 0.0) for at in held_to.coefficients])
    for process in chosen:
        fractions = [process.factors.get(at, 0.0) for at in held_to.coefficients]
        coef += values[process.role, process.term] * np.array(fractions)
    terms: dict[str, dict[str, float]] = {state: {} for state in STATES}
    for (state, term), value in zip(held_to.coefficients, coef.tolist(), strict=True):
        terms[state][term] = value
    return model_of(terms["n_i"], terms["n_n"]), held_to


ROLES = ep.Roles(exchange=[("n_n", "n_i")], outflow=STATES, inflow={"n_n": 2e23}, nonnegative=True)
VALUES = {
    ("n_n to n_i", "n_n"): 200.0, ("n_n to n_i", "n_i*n_n"): 4e-14, ("n_i out", "n_i"): 4e5,
    ("n_n out", "n_n"): 1000.0,
}  # fmt: skip


def test_processes_of_a_conserving_model(data: ep.Trajectory, exact: xr.Dataset) -> None:
    model, held_to = under(ROLES, VALUES)
    n_i, n_n = data.states.T
    compared = compared_processes(model, held_to, data, Zones({"": exact}))
    found = {each.name.split(",")[0]: each for each in compared}
    exchanged = found["neutrals that become ions"]
    np.testing.assert_allclose(exchanged.modelled, 4e-14 * n_i * n_n + 200.0 * n_n)
    np.testing.assert_allclose(exchanged.recorded, exact["ionization"] - exact["returned"])
    np.testing.assert_allclose(found["ions that leave"].modelled, 4e5 * n_i)
    np.testing.assert_allclose(found["neutrals that leave"].modelled, 1000.0 * n_n)
    enter = found["neutrals that enter"]
    assert enter.ratio == pytest.approx(2e23 / float(exact["supply"].mean()))
    assert np.isnan(enter.r2)  # a constant has none
    left = exact["exit_i"].values
    off = np.square(left - 4e5 * n_i).sum() / np.square(left - left.mean()).sum()
    assert found["ions that leave"].r2 == pytest.approx(1.0 - off)


def test_what_ions_give_back_by_a_process_of_their_own_is_compared(data, exact) -> None:
    """Stated or found, it stands next to what walls and anode give back; ionization is whole."""
    stated = replace(ROLES, exchange=[("n_n", "n_i"), ("n_i", "n_n", {"n_i": 1e5})])
    free = VALUES | {("n_i to n_n", "n_i"): 1e5}
    for roles, values in ((stated, VALUES), (ROLES, free)):
        compared = compared_processes(*under(roles, values), data, Zones({"": exact}))
        found = {each.name: each for each in compared}
        np.testing.assert_allclose(found["neutrals that become ions"].recorded, exact["ionization"])
        back = found["ions that become neutrals, back from walls and anode"]
        np.testing.assert_allclose(back.recorded, exact["returned"])
        assert back.coef == pytest.approx({"n_i": 1e5})


def test_counterparts_are_those_of_the_record(data: ep.Trajectory, exact: xr.Dataset) -> None:
    """A record whose processes are made of the model's terms gives their coefficients."""
    n_i, n_n = data.states.T
    made = exact.assign(
        ionization=("time", 250.0 * n_n + 5e-14 * n_i * n_n + exact["returned"].values),
        exit_i=("time", 3e5 * n_i),
    )
    model, held_to = under(ROLES, VALUES)
    compared = compared_processes(model, held_to, data, Zones({"": made}))
    found = {each.name.split(",")[0]: each for each in compared}
    exchanged = found["neutrals that become ions"]
    assert exchanged.counterpart == pytest.approx({"n_n": 250.0, "n_i*n_n": 5e-14}, rel=1e-6)
    assert exchanged.fit_r2 == pytest.approx(1.0)
    assert found["ions that leave"].counterpart == pytest.approx({"n_i": 3e5})
    entered = float(exact["supply"].mean())
    assert found["neutrals that enter"].counterpart == pytest.approx({"1": entered})


def test_a_model_next_to_its_balance_has_the_processes_of_its_roles(data, exact) -> None:
    found, zones = under(ROLES, VALUES), Zones({"": exact})
    compared = model_balance(*found, data, zones)
    assert [each.coef for each in compared] == [
        {"1": 2e23}, {"n_n": 200.0, "n_i*n_n": pytest.approx(4e-14)}, {"n_i": pytest.approx(4e5)},
        {"n_n": pytest.approx(1000.0)},
    ]  # fmt: skip
    assert not model_balance(*found, data, Zones({}))  # a record without a balance


def test_a_model_with_functions_has_no_processes(data: ep.Trajectory, exact: xr.Dataset) -> None:
    library = ep.polynomial(STATES, degree=1, functions=["sqrt(n_i)"])
    coef = ep.model.coef_matrix(library, [{"n_i": -1e5, "sqrt(n_i)": 1e14}, {"n_n": -1e5}])
    model = ep.SparseModel(library, STATES, coef, dict.fromkeys(STATES, "m^-3"))
    assert not model_balance(model, None, data, Zones({"": exact}))
