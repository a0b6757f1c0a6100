import numpy as np
import pytest

pytest.importorskip("dysts")

from benchmarks.collection import collected, collected_draw, collected_names, counted, defined


def test_the_collection_is_read_as_it_is_written() -> None:
    """Equations of dysts, expanded: their rates are those of the package's own code."""
    from dysts import flows

    names = collected_names()
    assert len(set(names)) == len(names) == 81
    for name in ("Lorenz", "Aizawa", "HyperRossler", "SprottJerk", "LorenzCoupled"):
        system, entry = collected(name), getattr(flows, name)()
        x = system.initial + 0.1
        rates = np.array(entry.rhs(x, 0.0))
        np.testing.assert_allclose(system.model.derivative(x, np.empty(0)), rates, rtol=1e-12)
        assert system.duration_s == pytest.approx(10.0 * entry.period)
        assert round(system.duration_s * system.rate_Hz) == 1000
    with pytest.raises(ValueError, match="a system of polynomial equations named 'Duffing'"):
        collected("Duffing")


def test_records_start_anywhere_on_the_attractor() -> None:
    _, (alone,) = collected_draw("Rossler", 0.05, 0)
    wider, (first, second) = collected_draw("Rossler", 0.05, 0, n_trajectories=2, degree=3)
    _, (other,) = collected_draw("Rossler", 0.05, 1)
    assert np.array_equal(alone.states, first.states)
    assert len(wider.model.library) == 20
    starts = np.array([run.states[0] for run in (first, second, other)])
    assert np.ptp(starts, axis=0).max() > 1.0


def test_systems_are_counted_together() -> None:
    found = counted(defined(["STLSQ"]), ["Lorenz", "SprottA"], [0.01], 1)
    (row,) = found.to_dict("records")
    assert (row["system"], row["variant"], row["n"]) == ("dysts", "STLSQ", 2)
    assert 0 <= row["selected"] <= row["on_front"] <= 2
