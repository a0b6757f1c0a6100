"""What Python prints, in the unit of the record's time and to its end; what models take."""

import numpy as np
import pytest

import ep2sindy as ep


def test_models_take_tables_and_states_by_name() -> None:
    run = ep.lotka_volterra().trajectory()
    model = ep.lotka_volterra().model
    table = run.to_dataframe().reset_index()
    assert ep.evaluate(model, table).status == ep.evaluate(model, run).status
    by_name = model.simulate(run.t[:20], {"y": 0.5, "x": 1.0})
    assert np.array_equal(by_name.states, model.simulate(run.t[:20], [1.0, 0.5]).states)
    with pytest.raises(ValueError, match=r"a number for each of \['x', 'y'\], got {'x': 1.0}"):
        model.simulate(run.t[:20], {"x": 1.0})
    found = ep.discover(run, method=ep.Regression())
    with pytest.raises(ValueError, match=r"such as found\.model, got a Discovery"):
        ep.refine(found, run)  # type: ignore[arg-type]
    assert ep.evaluate(found, run).model is found.model
