"""What Python prints, in the unit of the record's time and to its end; what models take."""

import numpy as np
import pytest

import ep2sindy as ep


def test_what_is_found_in_a_record_over_years_is_shown_per_year() -> None:
    run = ep.data.hare_lynx()
    assert "t = 0 to 20 year in steps of 1 year" in repr(run)
    terms = {"hare": ["hare", "hare*lynx"], "lynx": ["lynx", "hare*lynx"]}
    found = ep.discover(run, ep.polynomial(run.names).only(terms))
    year_s = run.clock.seconds
    growth = found.model.terms("hare")["hare"]
    for shown in (repr(found), str(found.model), found.model._repr_html_()):
        assert f"{year_s * growth:.3g} (" in shown.replace(" (&plusmn;", " (")
        assert "year^-1" in shown
        assert "t in year" in shown
    assert growth < 1e-7  # numbers stay in SI
    again = ep.SparseModel.from_json(found.model.to_json())
    assert again == found.model
    assert str(again) == str(found.model)
    assert "clock" not in ep.lorenz().model.to_json()
    text = found.model.to_json()
    with pytest.raises(ValueError, match="a model file must hold"):
        ep.SparseModel.from_json(text.replace('"seconds": 31557600.0', '"seconds": -1'))


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
