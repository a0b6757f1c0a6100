"""Fits of given structures: `+exp=constrained`, `ils`, `weak` and `theories`."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import ep2sindy as ep
from ep2sindy.data.open import write_field
from ep2sindy.library.library import polynomial
from ep2sindy.model.model import SparseModel, model_of
from ep2sindy.studies.processes import Zones, compared_processes
from ep2sindy.studies.structures import Structure, balance_model
from tests import programs
from tests.fields import along_channel

STATES = ["n_i", "n_n"]
EXACT = {"n_i": {"n_i": -1.64e5, "n_i*n_n": 4.66e-14}, "n_n": {"n_n": 4.39e4, "n_i*n_n": -4.66e-14}}


def on_file(name: str, path: Path, output: Path, *inputs: str) -> list[str]:
    return [f"+exp={name}", *programs.on_file(path, output, *inputs)]


def constrained(path: Path, output: Path) -> list[str]:
    return on_file("constrained", path, output, "R_ion", "u_iz")


def ils(path: Path, output: Path) -> list[str]:
    """Predator and prey alone, for it conserves nothing, at toy size."""
    return [
        *on_file("ils", path, output), "~models.law", "n_windows=6", "windows=[60]", "n_draws=2",
        "forms.weak.test_functions.n_windows=500", "forms.weak.test_functions.n_points=50",
    ]  # fmt: skip


def weak(path: Path, output: Path) -> list[str]:
    windows = [f"forms.n_points_{n}.test_functions.n_windows=500" for n in (10, 50)]
    fewer = ["~fits.n_points_70", "~fits.n_points_300"]
    return [*on_file("weak", path, output), *windows, *fewer]


def theories(output: Path) -> list[str]:
    """Two structures at two points of the law, without a recorded balance."""
    points = ",".join(
        f"{{V_D_V: {100 * k}, mdot_mg_s: 5, data: {{path: {law_record(output, 1 + 0.1 * k)}}}}}"
        for k in (0, 1)
    )
    exchange = 'exchange: [[n_n, n_i, ["n_i^2*n_n", "n_i*n_n^2"]]]'
    outflow = 'outflow: {n_i: [n_i, "n_i^2"], n_n: [n_n]}'
    roles = f"+models.law.roles={{{exchange}, {outflow}, inflow: {{n_n: free}}}}"
    return [
        *on_file("theories", output, output), f"points=[{points}]", "~models", roles,
        "+models.predator_prey.terms={n_i: [n_i, n_i*n_n], n_n: [n_n, n_i*n_n]}",
        "parameters={V_D_V: null, mdot_mg_s: null}",
        "~fits.balance", "fits.refined.form=null", "n_windows=10",
    ]  # fmt: skip


@cache
def law_states(faster: float) -> np.ndarray:
    """The law of the breathing mode on its cycle, all of it `faster` by a factor."""
    law = {
        "n_i": {"n_i^2*n_n": 1.62e-32, "n_i*n_n^2": 3.12e-33, "n_i": -3.64e5, "n_i^2": -8.45e-14},
        "n_n": {"1": 2.31e23, "n_i^2*n_n": -1.62e-32, "n_i*n_n^2": -3.12e-33, "n_n": -2.76e3},
    }
    model = model_of(polynomial(STATES, degree=3), law, units=dict.fromkeys(STATES, "m^-3"))
    time = 1.5e-6 * np.arange(6000)
    return model.simulate(faster * time, [5e17, 8e18]).states[-2000:]


def law_record(folder: Path, faster: float) -> Path:
    path = folder / f"law_{faster}.nc"
    time = 1.5e-6 * np.arange(2000)
    columns = zip(STATES, law_states(faster).T, strict=True)
    data = {state: (values, "m^-3") for state, values in columns}
    write_field(along_channel(time, np.linspace(0.003, 0.027, 5), data), path)
    return path


def check_exact(equations: dict[str, dict[str, float]], rel: float) -> None:
    for state, terms in EXACT.items():
        assert equations[state] == pytest.approx(terms, rel=rel)


def test_relations_hold_to_the_last_digit(predator_prey: Path, tmp_path: Path) -> None:
    toy = [*constrained(predator_prey, tmp_path), "~models.ionization", "figures.duration_s=1e-4"]
    found = programs.computed(programs.composed(*toy))
    summary = found.summary
    assert (summary["data"]["n_samples"], summary["data"]["n_held_out"]) == (1200, 300)
    names = ("predator_prey", "velocity")
    assert list(summary["fits"]) == [f"{n}_{way}" for n in names for way in ("base", "constrained")]
    for name, shared in zip(names, ("n_i*n_n", "n_i*n_n*R_ion"), strict=True):
        base, held = (
            summary["models"][f"{name}_{w}"]["equations"] for w in ("base", "constrained")
        )
        assert held["n_i"][shared] == -held["n_n"][shared]
        assert base["n_i"][shared] != -base["n_n"][shared]
        assert summary["fits"][f"{name}_base"]["n_free"] == 4
        assert summary["fits"][f"{name}_constrained"]["n_free"] == 3
    # Second-order differences at 1.5 us on a 14 kHz wave: (omega dt)^2 / 6 = 0.3 %, and the
    # smoothing window flattens peaks by about 1 %.
    check_exact(summary["models"]["predator_prey_constrained"]["equations"], rel=0.02)
    found.check_figures("trajectories", "trajectories_started")


def test_refinements_return_predator_and_prey(predator_prey: Path, tmp_path: Path) -> None:
    found = programs.computed(programs.composed(*ils(predator_prey, tmp_path)))
    summary, refined = found.summary, ("refined", "refined_constrained")
    assert list(summary["fits"]) == ["base", "weak", "constrained", *refined]
    for name, fit in summary["fits"].items():
        exact = name in refined
        # A refinement has the error of one Runge-Kutta step alone, (omega dt)^4 / 120 = 3e-6 for a
        # sine, and the wave has harmonics; the others as above.
        check_exact(summary["models"][name]["equations"], rel=1e-4 if exact else 0.02)
        assert fit["refinement"] == ("converged" if exact else None)
        assert (summary["models"][name]["intervals"] is None) != exact
        assert bool(fit["r2"]) != exact
        # Of a Hann window on some four periods: 1 % of a bin at most.
        for end in ("", "_started"):
            assert fit[f"f_error{end}"] == pytest.approx(0.0, abs=1e-3 if exact else 0.02)
            ratios = list(fit[f"amplitude_ratio{end}"].values())
            assert ratios == pytest.approx([1.0, 1.0], abs=1e-3 if exact else 0.1)
    held = summary["models"]["refined_constrained"]["equations"]
    assert held["n_i"]["n_i*n_n"] == -held["n_n"]["n_i*n_n"]
    swept = summary["loss_against_window"]
    assert [(row["fit"], row["window"]) for row in swept] == [(name, 60) for name in refined]
    assert all(row["loss"] < 1e-6 and abs(row["f_error_started"]) < 1e-3 for row in swept)
    assert list(summary["spread"]) == list(refined)
    for spread in summary["spread"].values():
        assert (spread["n_runs"], spread["n_sustained"]) == (2, 2)
        assert spread["f_error"] == pytest.approx([0.0, 0.0], abs=1e-3)
        assert 0.0 <= spread["waveform"][0] <= spread["waveform"][1] < 1e-2
    found.check_figures("loss_against_window", "phase")


def test_weak_forms_find_predator_and_prey(predator_prey: Path, tmp_path: Path) -> None:
    found = programs.computed(programs.composed(*weak(predator_prey, tmp_path)))
    summary = found.summary
    # Differences: as above. Trapezia: (omega dt)^2 / 12 = 0.13 % for a sine, and the wave has
    # harmonics. Smooth windows: as good as exact.
    errors = {"differential": 0.02, "n_points_10": 5e-3, "n_points_50": 5e-3, "automatic": 1e-4}
    assert list(summary["fits"]) == [f"predator_prey_{n}" for n in errors] + ["thesis_differential"]
    for name, rel in errors.items():
        check_exact(summary["models"][f"predator_prey_{name}"]["equations"], rel=rel)
        fit = summary["fits"][f"predator_prey_{name}"]
        assert fit["f_error"] == pytest.approx(0.0, abs=0.01)
        assert fit["r2"] == pytest.approx({"n_i": 1.0, "n_n": 1.0}, abs=2e-3)
    automatic = summary["models"]["predator_prey_automatic"]  # its rows know their noise
    for state, (low, high) in ((s, automatic["intervals"][s][s]) for s in STATES):
        assert low < automatic["equations"][state][state] < high
    given = summary["models"]["thesis_differential"]["equations"]  # as it was given
    assert given["n_n"] == {"n_n": 4.93e4, "n_i*n_n": -5.17e-14}
    assert summary["fits"]["thesis_differential"]["n_free"] == 0


def test_the_laws_own_structure_is_sustained_at_both_points(tmp_path: Path) -> None:
    found = programs.computed(programs.composed(*theories(tmp_path)))
    over = found.summary["over_points"]
    assert over["law_refined"]["n_sustained"] == 2
    assert over["law_refined"]["f_error"] == pytest.approx([0.0, 0.0], abs=1e-4)
    assert over["law_refined"]["amplitude"] == pytest.approx([1.0, 1.0], abs=1e-3)
    assert over["predator_prey_refined"]["n_sustained"] == 0
    fits = found.report.tables["fits"].set_index("fit")
    assert fits.loc["law_refined, V_D_V=0, mdot_mg_s=5", "status"].startswith(
        "follows the samples for"
    )
    faster = found.summary["models"]["law_refined_1"]["equations"]["n_n"]
    assert faster["1"] == pytest.approx(1.1 * 2.31e23, rel=1e-3)
    assert faster["n_n"] == pytest.approx(1.1 * -2.76e3, rel=1e-2)
    found.check_figures("sustained")


def made_record() -> tuple[ep.Trajectory, Zones]:
    """A record whose processes are exactly those of terms."""
    time = 1.5e-6 * np.arange(2000)
    states = law_states(1.0)
    n_i, n_n = states.T
    rates = {
        "ionization": 1.7e-32 * n_i**2 * n_n + 5e-14 * n_i * n_n + 1e5 * n_i,
        "returned": 1e5 * n_i, "exit_i": 3e5 * n_i, "exit_n": 3e3 * n_n,
        "supply": 2e4 * n_n + 3e3 * n_n,
    }  # fmt: skip
    balance = xr.Dataset({k: ("time", v) for k, v in rates.items()}, coords={"time": time})
    return ep.Trajectory(time, states, STATES), Zones({"": balance})


def by_the_balance(roles: ep.Roles) -> SparseModel:
    run, zones = made_record()
    structure = Structure(roles=roles)
    library = structure.library("s", STATES)
    held = structure.constraint(library, run, zones, relations=True)
    return balance_model(library, held, run, zones)


def test_the_balance_gives_every_process_its_coefficients() -> None:
    """Where ions give nothing back, ionization is net; where none leave, the inflow is."""
    law = ep.Roles(
        exchange=[("n_n", "n_i", ["n_i^2*n_n", "n_i*n_n"])], outflow={"n_i": ["n_i"]},
        inflow={"n_n": ["n_n"]},
    )  # fmt: skip
    model = by_the_balance(law)
    gained = {"n_i^2*n_n": 1.7e-32, "n_i*n_n": 5e-14}
    assert model.terms("n_i") == pytest.approx(gained | {"n_i": -3e5}, rel=1e-6)
    lost = {term: -value for term, value in gained.items()}
    assert model.terms("n_n") == pytest.approx(lost | {"n_n": 2e4}, rel=1e-6)


@pytest.mark.parametrize(
    ("outflow", "inflow", "is_net"),
    [
        ({"n_i": ["n_i"], "n_n": ["n_i*n_n"]}, ["n_n"], False),  # what leaves stands apart
        ({"n_i": ["n_i"]}, 2e23, False),  # what enters was stated
        ({"n_i": ["n_i"]}, ["n_n"], True),
    ],
)
def test_what_enters_is_net_where_nothing_leaves(outflow, inflow, is_net: bool) -> None:
    run, zones = made_record()
    exchange = [("n_n", "n_i", ["n_i^2*n_n"])]
    roles = ep.Roles(exchange=exchange, outflow=outflow, inflow={"n_n": inflow})
    structure = Structure(roles=roles)
    library = structure.library("s", STATES)
    held = structure.constraint(library, run, zones, relations=True)
    empty = model_of(library, {state: {} for state in STATES}, units=run.units)
    (entering,) = [p for p in compared_processes(empty, held, run, zones) if not p.ends[0]]
    balance = zones.balances[""]
    left = balance["exit_n"].values if is_net else 0.0
    np.testing.assert_array_equal(entering.recorded, balance["supply"].values - left)
