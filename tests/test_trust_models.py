"""A model file from someone else, and libraries that no machine holds."""

import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.trust import memory

MODEL = json.loads(ep.lorenz().model.to_json())
EQUATIONS = MODEL["equations"]
N = sum(map(len, EQUATIONS.values()))
BAD: list[tuple[dict[str, Any], str]] = [
    ({"states": ["x", "x", "y", "z"]}, "more than once"),
    ({"equations": {**EQUATIONS, "x": {"x": float("nan")}}}, "no finite number"),
    ({"library": [*MODEL["library"], "x^999999999"]}, "may have up to 100 factors"),
    ({"covariance": (-np.eye(N)).tolist()}, "a variance below zero"),
    ({"covariance": (np.eye(N) + 0.5 * np.eye(N, k=1)).tolist()}, "not symmetric"),
    ({"covariance": [["1"] * N] * N}, "a covariance that is not of numbers"),
]


@pytest.mark.parametrize(("change", "message"), BAD)
def test_a_model_that_cannot_be_is_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=r"a model file must hold .* JSON: .*") as caught:
        ep.SparseModel.from_json(json.dumps(MODEL | change))
    assert caught.match(message)


@pytest.mark.parametrize("text", ["", "[]", "null", "1", "[" * 100_000, "9" * 100_000, "{}", "\0"])
def test_text_that_is_no_model_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="a model file must hold"):
        ep.SparseModel.from_json(text)


def test_a_model_with_its_covariance_comes_back_exactly() -> None:
    root = np.random.default_rng(0).standard_normal((N, 3))  # of rank 3: as of constrained fits
    scale = np.diag(10.0 ** np.arange(-20.0, -20.0 + 4 * N, 4))
    text = json.dumps(MODEL | {"covariance": (scale @ root @ root.T @ scale).tolist()})
    found = ep.SparseModel.from_json(text)
    assert json.loads(found.to_json()) == json.loads(text)


TOO_LARGE: list[tuple[Callable[[], object], str]] = [
    (lambda: ep.polynomial(["x"], degree=300), "degree must be 100 or less, got 300"),
    (lambda: ep.polynomial(list("abcdefgh"), degree=99), "degree=8 makes 12870"),
    (lambda: ep.named_terms(["x"], ["x^200"]), "a term may have up to 100 factors"),
]


@pytest.mark.parametrize(("make", "message"), TOO_LARGE)
def test_a_library_is_counted_before_it_is_made(make: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


def test_gram_matrices_are_counted_before_they_are_made(monkeypatch: pytest.MonkeyPatch) -> None:
    """1771 terms in 32 bootstraps: 4 GB, where 2 GB are free."""
    monkeypatch.setattr(memory, "free_bytes", lambda: 2_000_000_000)
    run = ep.lorenz().trajectory(noise=0.05, rng=0)
    recipe = ep.Regression(ep.Differential(), ep.STLSQ(), ep.Knee(), ep.Bootstraps(n=32))
    library = ep.polynomial(["x", "y", "z"], degree=20)
    assert len(library) == 1771
    with pytest.raises(ValueError, match=r"Gram matrices of 1771 terms in 32 boot.* GB are free"):
        ep.discover(run, library, recipe)


def test_a_search_of_all_subsets_counts_what_it_carries_along(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """600 terms at sizes up to 100: 101 matrices of 601 x 601."""
    monkeypatch.setattr(memory, "free_bytes", lambda: 200_000_000)
    message = r"600 terms at each of 100 sizes would take 0.292 GB .* lower max_terms"
    with pytest.raises(ValueError, match=message):
        ep.BestSubset(max_terms=100).supports(np.eye(600), np.ones(600), 600.0)
