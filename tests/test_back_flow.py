"""Where ions flow back, their outflow goes with the neutrals, too."""

from pathlib import Path

import pytest

from tests.programs import composed, computed


@pytest.mark.slow
def test_where_ions_flow_back_a_law_is_found_that_is_sustained(tmp_path: Path) -> None:
    found = computed(
        composed(
            "+exp=breathing",
            "sustained=back_flow",
            "thruster=lif",
            "data.operating_point.neutral_speed=220",
            "~libraries.ionization",
            "~libraries.velocity",
            "forecasts=0",
            f"output={tmp_path}",
        )
    ).summary
    run = found["evaluations"]["simple_sustained"]
    assert run["status"] == "sustained"
    assert run["f_error"] == pytest.approx(0.0, abs=1e-3)
    balance = {(each["part"], each["term"]): each for each in found["terms_simple"]}
    leave = {term: each for (part, term), each in balance.items() if part == "ions that leave"}
    assert set(leave) == {"n_i", "n_i^2", "n_i*n_n^2"}
    for each in leave.values():
        assert each["ratio"] == pytest.approx(1.0, abs=0.2)  # next to the record's
