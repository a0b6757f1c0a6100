"""Settings of the wrong kind are refused where they are given, with a hint."""

from collections.abc import Callable

import numpy as np
import pytest

import ep2sindy as ep

T = np.linspace(0.0, 3.0, 31)
X = np.column_stack([np.exp(-T), np.sin(T)])
LIBRARY = ep.polynomial(["x", "y"], degree=2)

TEXTS = {
    "the terms of 'x'": lambda: LIBRARY.only({"x": "x*y"}),
    "products": lambda: ep.polynomial(["x", "y"], degree=1, products="x*y"),
    "state_names": lambda: ep.Trajectory(T, X, "xy"),
}


@pytest.mark.parametrize("name", TEXTS)
def test_a_text_where_a_list_belongs_is_refused(name: str) -> None:
    call: Callable[[], object] = TEXTS[name]
    with pytest.raises(ValueError, match=rf"{name.strip()} must be a list, got '.*'; write \['"):
        call()


NO_COUNTS: dict[str, Callable[[object], object]] = {
    "max_terms": lambda n: ep.BestSubset(max_terms=n),
    "n_folds": lambda n: ep.FreeRunScore(n_folds=n),
    "degree": lambda n: ep.polynomial(["x"], degree=n),
}


@pytest.mark.parametrize("count", [2.5, -1, "2", True, None], ids=str)
@pytest.mark.parametrize("name", NO_COUNTS)
def test_what_is_no_whole_number_is_refused(name: str, count: object) -> None:
    if count is None and name.strip() == "max_terms":
        return  # of some searches, all terms
    message = f"^{name.strip()} must be a whole number, (zero|one|two) or more, got {count!r}$"
    with pytest.raises(ValueError, match=message):
        NO_COUNTS[name](count)


def test_whole_numbers_of_numpy_are_taken_and_kept_as_they_are_written() -> None:
    two = np.int64(2)
    assert repr(ep.Regression(depth=two).depth) == "2"
    assert ep.BestSubset(two, two) == ep.BestSubset(2, 2)
    assert repr(ep.TrajectorySearch(two, depth=two)) == repr(ep.TrajectorySearch(2, depth=2))
    assert ep.polynomial(["x"], degree=two).names == ("1", "x", "x^2")


WRONG_KINDS = [
    (lambda: ep.WeightedWeak(weak=ep.Differential()), "weak must be a Weak, such as ep.Weak"),
    (lambda: ep.Differential(smoother="kalman"), "smoother must be a Smoother, such as ep.sig"),
    (
        lambda: ep.Regression(selection=ep.discovery.Evidence()),
        "Evidence weighs what a search of trajector",
    ),
]


@pytest.mark.parametrize(("call", "message"), WRONG_KINDS)
def test_a_setting_of_another_kind_is_refused_before_the_search(
    call: Callable[[], object], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        call()
