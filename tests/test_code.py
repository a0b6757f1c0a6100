"""Models as programs: what they compute is what the model computes, in every language."""

import ctypes
import keyword
import math
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import ep2sindy as ep
from ep2sindy.library import code
from ep2sindy.library import functions as registry
from ep2sindy.library.functions import SYMPY_NAMES
from ep2sindy.library.library import named_terms

COMPILER = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
NO_COMPILER = pytest.mark.skipif(COMPILER is None, reason="this machine has no C compiler")
LANGUAGES = ["python", "c", "julia", "modelica"]
STRICT = {"rtol": 1e-12, "atol": 1e-12, "method": "DOP853"}

Rates = Callable[..., np.ndarray]


@pytest.fixture
def kinds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Functions that are known, as before when the test ends."""
    monkeypatch.setattr(registry, "_kinds", dict(registry._kinds))


def hill(x: Any) -> Any:
    return x**2 / (1.0 + x**2)


def hill_slope(x: Any) -> Any:
    return 2.0 * x / (1.0 + x**2) ** 2


def model_with(terms: list[str], states: list[str], inputs: list[str] | None = None) -> Any:
    """Every term in every equation, with coefficients that no short decimal holds."""
    library = named_terms([*states, *(inputs or [])], terms)
    coef = np.random.default_rng(3).normal(size=(len(terms), len(states)))
    return ep.SparseModel(library, states, coef)


def driven() -> ep.SparseModel:
    """A pendulum that is damped by the air and pushed."""
    library = named_terms(["theta", "w", "u"], ["w", "sin(theta)", "w*abs(w)", "u"])
    equations = [{"w": 1.0}, {"sin(theta)": -9.81, "w*abs(w)": -0.1, "u": 1.0}]
    return ep.SparseModel(library, ["theta", "w"], ep.coef_matrix(library, equations))


FUNCTIONS = ["1", "sin(-2*x)*v^2", "cos(x)", "exp(-0.5*x)", "log(1+x)", "sqrt(1e-18*x)*abs(2*v)"]
FUNCTIONS += ["1/(1e20+x)", "v/(0.1+x)^2", "sign(3*v)*u", "x*v/u^3", "1/(-x)"]
MODELS = {
    "products": lambda: ep.lorenz().model,
    "functions": lambda: model_with(FUNCTIONS, ["x", "v"], ["u"]),
    "one state": lambda: model_with(["1", "x", "x^7"], ["x"]),
    "names": lambda: model_with(
        ["end*der*np", "n_i@exit^2*<x*y>", "double/lambda", "sin*α", "t*states"],
        ["end", "der", "double", "lambda", "np", "sin", "t", "n_i@exit", "<x*y>", "α"],
        ["rates", "states"],
    ),
    "a state and an input that nobody needs": lambda: ep.SparseModel(
        named_terms(["x", "y", "a", "b"], ["y", "b"]), ["x", "y"], np.array([[0.0, -0.1]] * 2)
    ),
}
BY_NAME = pytest.mark.parametrize("name", MODELS)


def python_rates(model: ep.SparseModel) -> Rates:
    known: dict[str, Any] = {"__name__": "exported"}
    exec(model.to_code("python"), known)
    return known["rhs"]


def c_rates(model: ep.SparseModel, folder: Path) -> Rates:
    (folder / "model.c").write_text(model.to_code("c"), encoding="utf-8")
    flags = ["-std=c99", "-O1", "-Wall", "-Wextra", "-pedantic", "-Werror", "-shared", "-fPIC"]
    subprocess.run(
        [str(COMPILER), *flags, "model.c", "-o", "model.so", "-lm"], cwd=folder, check=True
    )
    function = ctypes.CDLL(str(folder / "model.so")).rhs
    array = np.ctypeslib.ndpointer(np.float64, flags="C_CONTIGUOUS")
    function.argtypes = [ctypes.c_double, array, array, array]
    function.restype = None

    def rates(t: float, states: np.ndarray, inputs: Any = ()) -> np.ndarray:
        found = np.empty(len(states))
        function(t, np.array(states, float), np.array([*inputs, 0.0]), found)
        return found

    return rates


def points(model: ep.SparseModel) -> tuple[np.ndarray, np.ndarray]:
    """States and inputs at some points inside the domain of all functions."""
    rng = np.random.default_rng(5)
    return rng.uniform(0.3, 2.0, (20, len(model.states))), rng.uniform(
        0.5, 1.5, (20, len(model.inputs))
    )


@BY_NAME
def test_python_computes_what_the_model_does(name: str) -> None:
    model = MODELS[name]()
    rates, (states, inputs) = python_rates(model), points(model)
    expected = model.derivative(states, inputs)
    found = [rates(0.0, x, u) for x, u in zip(states, inputs, strict=True)]
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)
    at_once = rates(0.0, states.T, inputs.T)
    np.testing.assert_allclose(at_once.T, expected, rtol=1e-12, atol=1e-12)


@NO_COMPILER
@BY_NAME
def test_c_computes_what_the_model_does(name: str, tmp_path: Path) -> None:
    model = MODELS[name]()
    rates, (states, inputs) = c_rates(model, tmp_path), points(model)
    found = [rates(0.0, x, u) for x, u in zip(states, inputs, strict=True)]
    np.testing.assert_allclose(found, model.derivative(states, inputs), rtol=1e-12, atol=1e-12)


def made(language: str, model: ep.SparseModel, folder: Path) -> Rates:
    return python_rates(model) if language == "python" else c_rates(model, folder)


@pytest.mark.parametrize("language", ["python", pytest.param("c", marks=NO_COMPILER)])
def test_ten_periods_are_those_of_simulate(language: str, tmp_path: Path) -> None:
    model, x0 = ep.lotka_volterra().model, [1.0, 0.5]
    t = np.linspace(0.0, 150.0, 1501)  # a period takes 14.3 s
    run = model.simulate(t, x0, rtol=1e-11)
    found = solve_ivp(made(language, model, tmp_path), t[[0, -1]], x0, t_eval=t, **STRICT)
    assert np.abs(found.y.T / run.states - 1.0).max() < 1e-6


@pytest.mark.parametrize("language", ["python", pytest.param("c", marks=NO_COMPILER)])
def test_ten_periods_of_a_driven_model_are_those_of_simulate(language: str, tmp_path: Path) -> None:
    model, x0 = driven(), [1.0, 0.0]
    t = np.linspace(0.0, 25.0, 501)  # swings of 2.1 s, pushes of 3.1 s
    run = model.simulate(t, x0, {"u": lambda now: math.sin(2.0 * now)}, rtol=1e-11)
    rates = made(language, model, tmp_path)
    found = solve_ivp(
        lambda now, x: rates(now, x, [math.sin(2.0 * now)]), t[[0, -1]], x0, t_eval=t, **STRICT
    )
    assert np.abs(found.y.T - run.states).max() < 1e-6 * np.abs(run.states).max()


@NO_COMPILER
def test_densities_of_a_thruster_keep_their_size(tmp_path: Path) -> None:
    """States of 1e18 and coefficients of 1e-14, over ten periods of 0.1 ms."""
    library = named_terms(["n_i", "n_n"], ["n_i", "n_n", "n_i*n_n"])
    terms = [{"n_i": -1.64e5, "n_i*n_n": 4.66e-14}, {"n_n": 4.39e4, "n_i*n_n": -4.66e-14}]
    model = ep.SparseModel(library, ["n_i", "n_n"], ep.coef_matrix(library, terms))
    t, x0 = np.linspace(0.0, 1e-3, 1001), np.array([5e17, 4e18])
    run = model.simulate(t, x0, rtol=1e-11)
    for rates in (python_rates(model), c_rates(model, tmp_path)):
        found = solve_ivp(
            rates, t[[0, -1]], x0, t_eval=t, method="DOP853", rtol=1e-12, atol=1e-12 * x0
        )
        assert np.abs(found.y.T / run.states - 1.0).max() < 1e-6


# No compiler of these is at hand: their equations are read back, as an expression of Python's.

EQUATION = {
    "julia": re.compile(r"^    rates\[(\d+)\] = (\([^;]*?\n    \)|.*)$", re.M),
    "modelica": re.compile(r"^    der\((\w+)\) = ([^;]*);$", re.M),
}
COEF = {
    "julia": re.compile(r"^    (c_\w+) = (\S+),  # (.*)$", re.M),
    "modelica": re.compile(r'^    parameter Real (c_\w+) = (\S+) "(.*)";$', re.M),
}
TEXTS = pytest.mark.parametrize("language", ["julia", "modelica"])


def names_of(model: ep.SparseModel, language: str) -> list[str]:
    written = code.LANGUAGES[language]
    return [*code.identifiers([*model.states, *model.inputs], written.reserved).values()]


def in_python(expression: str) -> str:
    return re.sub(r"\blambda\b", "lambda_", expression.replace("^", "**"))


@TEXTS
@BY_NAME
def test_equations_in_a_text_are_those_of_the_model(language: str, name: str) -> None:
    model = MODELS[name]()
    text, names = model.to_code(language), names_of(model, language)
    found = EQUATION[language].findall(text)
    places = (
        [names.index(f) for f, _ in found]
        if language == "modelica"
        else [int(f) - 1 for f, _ in found]
    )
    assert places == list(range(len(model.states)))
    coefs = {c: float(number) for c, number, _ in COEF[language].findall(text)}
    known = {**vars(math), **coefs, "abs": abs}
    for x, u in zip(*points(model), strict=True):
        values = dict(zip(map(in_python, names), [*x.tolist(), *u.tolist()], strict=True))
        here = {**known, **values}
        rates = [eval(in_python(f), {}, here) for _, f in found]
        np.testing.assert_allclose(rates, model.derivative(x, u), rtol=1e-12, atol=1e-12)


@TEXTS
@BY_NAME
def test_coefficients_in_a_text_are_read_back_exactly(language: str, name: str) -> None:
    model = MODELS[name]()
    found = [
        (term, float(number)) for _, number, term in COEF[language].findall(model.to_code(language))
    ]
    expected = [(f"{n} in {s}'", c) for s in model.states for n, c in model.terms(s).items()]
    assert found == expected


def test_julia_takes_states_from_their_places() -> None:
    text = MODELS["a state and an input that nobody needs"]().to_code("julia")
    assert "    y = states[2]\n    b = input_b(t)\n    rates[1] = 0.0\n" in text


def test_julia_unpacks_what_its_equations_hold() -> None:
    model = MODELS["functions"]()
    text = model.to_code("julia", x0=[1.0, 2.5], duration_s=3e-3)
    body = re.search(r"function rhs!\(rates, states, parameters, t\)\n(.*?)\nend", text, re.S)
    assert body is not None
    assert "    x = states[1]\n    v = states[2]\n    u = input_u(t)\n" in body[1]
    assert "input_u(t) = 0.0" in text
    unpacked = re.search(r"\(; (.*?)\) = parameters", body[1], re.S)
    assert unpacked is not None
    assert unpacked[1].replace(",", "").split() == [c for c, _, _ in COEF["julia"].findall(text)]
    assert "ODEProblem(rhs!, start, (0.0, 0.003), parameters)" in text
    assert "        1.0,  # x\n        2.5,  # v\n" in text


def test_modelica_declares_states_inputs_and_the_run() -> None:
    text = MODELS["functions"]().to_code("modelica", x0=[1.0, 2.5], duration_s=3e-3)
    assert "    input Real u " in text
    assert "    Real x(start = 1.0, fixed = true) " in text
    assert "    Real v(start = 2.5, fixed = true) " in text
    assert "annotation(experiment(StopTime = 0.003, Tolerance = 1e-8));\nend Equations;\n" in text
    program = re.sub(r'//.*|"(?:[^"\\]|\\.)*"', "", text)
    assert not re.search(r"[*/^]\s*-", program), "a sign after an operator is no Modelica"


@pytest.mark.parametrize("language", LANGUAGES)
def test_names_are_legal_and_distinct(language: str) -> None:
    names = names_of(MODELS["names"](), language)
    assert len(set(names)) == len(names)
    assert all(re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name) for name in names)
    assert not set(names) & code.LANGUAGES[language].reserved
    kept = {"python": "end", "c": "lambda", "julia": "double", "modelica": "np"}[language]
    assert kept in names
    changed = {"python": "np_", "c": "double_", "julia": "end_", "modelica": "der_"}[language]
    assert changed in names
    text = MODELS["names"]().to_code(language)
    assert f"{changed} in 1, {changed[:-1]} in the model" in text
    assert "alpha in 1, α in the model" in text
    assert ", or this program, cannot take are changed." in text


def test_a_name_that_is_free_is_kept_by_its_owner() -> None:
    words = frozenset({"end"})
    assert code.identifiers(["end", "end_", "x@a", "x_a", "_"], words) == {
        "end": "end__", "end_": "end_", "x@a": "x_a_", "x_a": "x_a", "_": "v_",
    }  # fmt: skip
    # Two letters that look alike, and names such as those of coefficients.
    assert code.identifiers(["µ", "μ", "é", "c_x_1"], words) == {
        "µ": "mu", "μ": "mu_", "é": "e", "c_x_1": "c_x_1_",
    }  # fmt: skip


def test_words_of_python_are_reserved() -> None:
    assert set(keyword.kwlist) <= code.LANGUAGES["python"].reserved


@pytest.mark.parametrize("language", LANGUAGES)
def test_the_comment_says_what_the_model_is(language: str) -> None:
    library = named_terms(["n_i", "V_d"], ["n_i", "V_d", "log(n_i)"])
    model = ep.SparseModel(
        library, ["n_i"], np.ones((3, 1)), {"n_i": "m^-3", "V_d": "V"}, {"search": "by hand"}
    )
    mark = code.LANGUAGES[language].mark
    lines = model.to_code(language).splitlines()
    head = [line.removeprefix(mark).strip() for line in lines if line.startswith(mark)]
    assert head[0].startswith(f"Equations of a model of EP2-SINDy {ep.__version__}, in SI units")
    assert "n_i' = 1 n_i + 1 V_d + 1 log(n_i)" in head
    for title, row in (
        ("states:", "n_i in m^-3"),
        ("inputs:", "V_d in V"),
        ("domain:", "log(n_i) needs n_i > 0"),
        ("provenance:", "search: by hand"),
    ):
        assert head[head.index(title) + 1] == row


NASTY = {
    "a": "ends in \\",
    "b": "ends in ??/",
    "c": '*/ """ =#\nraise SystemExit\x0c\u2028error\u202e',
    "d": "word " * 60,
}


@pytest.mark.parametrize("language", LANGUAGES)
def test_no_text_leaves_its_comment(language: str) -> None:
    plain = model_with(["x", "u"], ["x"], ["u"])
    model = ep.SparseModel(plain.library, ["x"], plain.coef, {"x": 'm"; \\', "u": "V\n*/ x"}, NASTY)
    mark = code.LANGUAGES[language].mark
    whole = model.to_code(language)
    assert all(character.isprintable() or character == "\n" for character in whole)

    def program(text: str) -> list[str]:
        lines = [line for line in text.split("\n") if not line.startswith(mark)]
        return [re.sub(r'"(?:[^"\\]|\\.)*"', '""', line) for line in lines]

    assert program(whole) == program(plain.to_code(language))
    comments = [line for line in whole.split("\n") if line.startswith(mark)]
    assert not [line for line in comments if line.endswith(("\\", "??/"))]
    assert max(map(len, comments)) <= 100


@NO_COMPILER
def test_c_with_any_text_in_its_comments_is_compiled(tmp_path: Path) -> None:
    plain = model_with(["x"], ["x"])
    model = ep.SparseModel(plain.library, ["x"], plain.coef, {"x": "\\"}, NASTY)
    found = c_rates(model, tmp_path)(0.0, np.array([2.0]))
    assert found == pytest.approx(model.predict([2.0]))


@pytest.mark.parametrize("driven_by", [None, "u"])
def test_the_example_in_python_runs(
    driven_by: str | None, capsys: pytest.CaptureFixture[str]
) -> None:
    model = driven() if driven_by else ep.lotka_volterra().model
    x0 = [1.0, 0.5]
    exec(model.to_code("python", x0=x0, duration_s=2.0), {"__name__": "__main__"})
    run = model.simulate([0.0, 1.0, 2.0], x0, {"u": 0.0} if driven_by else None)
    numbers = re.search(r"at 2\.0 s: \[(.*)\]", capsys.readouterr().out)
    assert numbers is not None
    assert [*map(float, numbers[1].split())] == pytest.approx(run.states[-1], rel=1e-6)


# Functions of a user's own.


@pytest.mark.parametrize("language", LANGUAGES)
def test_a_function_of_ones_own_is_written_out(language: str, kinds: None) -> None:
    ep.register_function("hill", hill, hill_slope)
    text = model_with(["x*hill(0.3*x)"], ["x"]).to_code(language)
    square = "pow(x, 2)" if language == "c" else "x**2" if language == "python" else "x^2"
    assert f"c_x_1*x*(0.09*{square}/(1 + 0.09*{square}))" in text


def test_a_function_of_ones_own_computes_what_it_did(kinds: None) -> None:
    ep.register_function("hill", hill, hill_slope)
    model = model_with(["x*hill(0.5-0.3*x)", "hill(x)^2/x"], ["x"])
    (states, inputs), rates = points(model), python_rates(model)
    expected = model.derivative(states, inputs)
    np.testing.assert_allclose(rates(0.0, states.T).T, expected, rtol=1e-12)


@NO_COMPILER
def test_every_function_of_numpy_has_its_name_in_every_language(
    kinds: None, tmp_path: Path
) -> None:
    for name in SYMPY_NAMES:
        of = getattr(np, name)
        ep.register_function(
            f"own_{name}",
            lambda x, of=of: of(x),
            lambda x, of=of: (of(x + 1e-6) - of(x - 1e-6)) / 2e-6,
            domain=(0.1, 0.9),
        )
    model = model_with([f"own_{name}(x)" for name in SYMPY_NAMES], ["x"])
    states = np.array([[0.3], [0.7]])
    expected = model.derivative(states, np.empty((2, 0)))
    for rates in (python_rates(model), c_rates(model, tmp_path)):
        found = [rates(0.0, x) for x in states]
        np.testing.assert_allclose(found, expected, rtol=1e-12)
    for language in ("julia", "modelica"):
        called = set(re.findall(r"\*(\w+)\(x\)", model.to_code(language)))
        assert called == {*SYMPY_NAMES.values()} - {"Abs"} | {"abs"}


def by_branches(x: Any) -> Any:
    return np.where(x > 0.0, x, 0.0 * x)


def by_points(x: Any) -> Any:
    return np.interp(x, [-100.0, 0.0, 100.0], [-100.0, 0.0, 100.0])


def by_kind(x: Any) -> Any:
    return x + 1.0 if isinstance(x, np.ndarray) else x


@pytest.mark.parametrize(
    ("function", "slope", "reason"),
    [
        (by_branches, lambda x: np.where(x > 0.0, 1.0, 0.0), "greater"),
        (by_points, lambda x: np.ones_like(x), "float"),
        (by_kind, lambda x: np.ones_like(x), "as a formula it has other values"),
    ],
)
@pytest.mark.parametrize("language", LANGUAGES)
def test_a_function_that_is_no_formula_is_refused(
    language: str, function: Any, slope: Any, reason: str, kinds: None
) -> None:
    ep.register_function("mine", function, slope, domain=(-1.0, 1.0))
    model = model_with(["mine(x)"], ["x"])
    with pytest.raises(ValueError, match=r"np\.tanh.*'mine' came, which is none.*register") as e:
        model.to_code(language)
    assert reason in str(e.value)


# Errors.


def test_another_language_is_refused_with_the_four() -> None:
    four = r"\['python', 'c', 'julia', 'modelica'\]: language 'fortran' came"
    with pytest.raises(ValueError, match=four):
        ep.lorenz().model.to_code("fortran")


def test_a_wrong_start_is_refused() -> None:
    with pytest.raises(ValueError, match=r"number for each of \['x', 'y', 'z'\]: \[1.0\] came$"):
        ep.lorenz().model.to_code("python", x0=[1.0])


@pytest.mark.parametrize("duration_s", [0.0, -1.0, np.inf, np.nan])
def test_a_wrong_duration_is_refused(duration_s: float) -> None:
    with pytest.raises(ValueError, match="duration_s must be positive and finite"):
        ep.lorenz().model.to_code("modelica", duration_s=duration_s)


def test_a_loaded_model_is_written_alike() -> None:
    model = MODELS["functions"]()
    again = ep.SparseModel.from_json(model.to_json())
    assert [again.to_code(x) for x in LANGUAGES] == [model.to_code(x) for x in LANGUAGES]
