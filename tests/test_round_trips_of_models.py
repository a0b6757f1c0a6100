"""Libraries and models say the same however they are written, stored or asked."""

import json
import pickle
from collections.abc import Sequence
from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import ep2sindy as ep

FEW = settings(max_examples=12, deadline=None, derandomize=True)
NAMES = ["x", "n_i", "T_e_eV", "µ"]
FUNCTIONS = ["sin({})", "cos(2*{})", "exp(-{})", "log(1+{})", "sqrt({})", "abs({})", "1/(0.5+{})"]
NUMPY = {
    "sin({})": np.sin, "cos(2*{})": lambda x: np.cos(2.0 * x), "exp(-{})": lambda x: np.exp(-x),
    "log(1+{})": lambda x: np.log(1.0 + x), "sqrt({})": np.sqrt, "abs({})": np.abs,
    "1/(0.5+{})": lambda x: 1.0 / (0.5 + x),
}  # fmt: skip
POSITIVE = st.floats(0.125, 3.0, width=32)

Powers = list[tuple[str, int]]


@st.composite
def terms(draw: st.DrawFn, names: Sequence[str]) -> Powers:
    """Factors, variables or functions of one, and their powers; each once."""
    factors = [*names, *(each.format(n) for n in names for each in FUNCTIONS)]
    chosen = draw(st.lists(st.sampled_from(factors), max_size=3, unique=True))
    return [(factor, draw(st.integers(1, 3))) for factor in chosen]


def written(powers: Powers) -> str:
    over = [(f, p) for f, p in powers if not f.startswith("1/")]
    under = [(f, p) for f, p in powers if f.startswith("1/")]
    text = "*".join(f if p == 1 else f"{f}^{p}" for f, p in over) or "1"
    return text + "".join(f[1:] + ("" if p == 1 else f"^{p}") for f, p in under)


def by_numpy(powers: Powers, values: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """What a term is, written out without the library."""
    found = np.ones(len(values))
    for factor, power in powers:
        for k, name in enumerate(names):
            shapes = {name: lambda x: x} | {t.format(name): f for t, f in NUMPY.items()}
            if factor in shapes:
                found = found * shapes[factor](values[:, k]) ** power
    return found


@st.composite
def libraries(draw: st.DrawFn) -> tuple[list[str], list[Powers]]:
    names = draw(st.lists(st.sampled_from(NAMES), min_size=1, max_size=3, unique=True))
    chosen = draw(st.lists(terms(names), min_size=1, max_size=5, unique_by=lambda t: frozenset(t)))
    return names, chosen


SAMPLES = arrays(np.float32, (6, 3), elements=POSITIVE).map(lambda v: v.astype(np.float64))


@FEW
@given(libraries(), SAMPLES)
def test_a_library_is_what_its_names_say(library: Any, values: np.ndarray) -> None:
    names, powers = library
    values = values[:, : len(names)]
    found = ep.named_terms(names, [written(each) for each in powers])
    wanted = np.stack([by_numpy(each, values, names) for each in powers], axis=1)
    theta = found.evaluate(values)
    np.testing.assert_allclose(theta, wanted, rtol=1e-13)
    again = ep.named_terms(names, found.names)
    assert again.names == found.names
    np.testing.assert_array_equal(again.evaluate(values), theta)
    kept = values.copy()
    kept.flags.writeable = False
    for given_as in (np.asfortranarray(values), kept, np.repeat(values, 2, axis=0)[::2]):
        np.testing.assert_array_equal(found.evaluate(given_as), theta)


@FEW
@given(
    libraries(), SAMPLES, arrays(np.float64, 3, elements=st.sampled_from([1e-6, 0.25, 3.0, 1e18]))
)
def test_terms_in_other_units_are_the_same_numbers(
    library: Any, values: np.ndarray, scale: np.ndarray
) -> None:
    names, powers = library
    values, scale = values[:, : len(names)], scale[: len(names)]
    found = ep.named_terms(names, [written(each) for each in powers])
    scaled, back = found.scaled(scale)
    np.testing.assert_allclose(
        scaled.evaluate(values / scale) * back, found.evaluate(values), rtol=1e-11
    )


@st.composite
def models(draw: st.DrawFn) -> ep.SparseModel:
    """Any terms, any coefficients and units, and sometimes a covariance."""
    names, powers = draw(libraries())
    library = ep.named_terms(names, [written(each) for each in powers])
    states = names[: draw(st.integers(1, len(names)))]
    sizes = st.sampled_from([0.0, 1.0, -2.5e-19, 3.7e22, 0.1, -7.0 / 3.0])
    coef = draw(arrays(np.float64, (len(library), len(states)), elements=sizes))
    n = int(np.count_nonzero(coef))
    root = draw(arrays(np.float64, (n, n), elements=st.integers(-3, 3).map(float)))
    size = coef.T[coef.T != 0.0]
    covariance = 1e-4 * np.outer(size, size) * (root @ root.T)
    units = {name: draw(st.sampled_from(["1", "m^-3", "eV", "kg m^-1"])) for name in names}
    known = draw(st.booleans())
    return ep.SparseModel(
        library, states, coef, units, {"by": "é<>"}, covariance if known else None
    )


@FEW
@given(models(), SAMPLES)
def test_a_model_comes_back_from_text_and_pickle(model: ep.SparseModel, values: np.ndarray) -> None:
    values = values[:, : len(model.library.variables)]
    states, inputs = np.split(values, [len(model.states)], axis=1)
    rates = model.derivative(states, inputs)
    text = model.to_json()
    for again in (ep.SparseModel.from_json(text), pickle.loads(pickle.dumps(model))):
        assert again.to_json() == text
        assert again.text() == model.text()
        assert again.latex() == model.latex()
        np.testing.assert_array_equal(again.derivative(states, inputs), rates)
        if model.covariance is not None:
            np.testing.assert_array_equal(again.covariance, model.covariance)
    assert json.loads(text)["units"] == dict(model.units)


@settings(FEW, max_examples=5)  # sympy takes its time
@given(models(), SAMPLES)
def test_sympy_and_torch_reckon_as_numpy_does(model: ep.SparseModel, values: np.ndarray) -> None:
    import sympy
    import torch

    values = values[:, : len(model.library.variables)]
    columns = [list(model.library.variables).index(v) for v in (*model.states, *model.inputs)]
    states, inputs = np.split(values[:, columns], [len(model.states)], axis=1)
    rates = model.derivative(states, inputs)
    size = np.abs(model.library.evaluate(values)) @ np.abs(model.coef)
    symbols = list(map(sympy.Symbol, model.library.variables))
    by_torch = model.library.evaluate(torch.from_numpy(values)).numpy() @ model.coef
    assert (np.abs(by_torch - rates) <= 1e-12 * size).all()
    for k, expression in enumerate(model.sympy().values()):
        at = [
            float(expression.evalf(30, subs=dict(zip(symbols, row, strict=True))))
            for row in values[:2].tolist()
        ]
        assert (np.abs(np.array(at) - rates[:2, k]) <= 1e-12 * size[:2, k]).all()
