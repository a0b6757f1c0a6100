from itertools import combinations

import numpy as np
import pytest

from ep2sindy.library.library import polynomial
from ep2sindy.operating.quantities import fit_control_law

# The thesis's six operating points, V and mg/s: a cross.
POINTS = np.array([[200, 5], [300, 2], [300, 4], [300, 5], [300, 6], [400, 5]], dtype=np.float64)
LIBRARY = polynomial(["V_D_V", "mdot_mg_s"], degree=2)


def test_a_law_without_noise_is_recovered() -> None:
    values = 0.02 + 3e-3 * POINTS[:, 1] - 4e-8 * POINTS[:, 0] ** 2
    law = fit_control_law(values, POINTS, LIBRARY, max_terms=3)
    assert law.coef_by_term == pytest.approx({"1": 0.02, "mdot_mg_s": 3e-3, "V_D_V^2": -4e-8})
    assert law.r2 == pytest.approx(1.0)
    assert law.loo_error < 1e-9
    new = np.array([[250.0, 3.0]])
    assert law.predict(new) == pytest.approx(0.02 + 9e-3 - 4e-8 * 250.0**2)


def test_a_law_of_one_term_beats_the_larger_ones_that_hold_it() -> None:
    law = fit_control_law(3.7e22 * POINTS[:, 1], POINTS, LIBRARY)
    assert law.functions.names == ("mdot_mg_s",)
    assert law.search_error < 1e-9


def test_what_does_not_vary_is_a_constant() -> None:
    law = fit_control_law(np.full(6, 0.8), POINTS, LIBRARY)
    assert law.coef_by_term == pytest.approx({"1": 0.8})
    assert np.isnan(law.r2)


@pytest.mark.parametrize("seed", range(3))
def test_leave_one_out_errors_are_those_of_fits_without_the_point(seed: int) -> None:
    rng = np.random.default_rng(seed)
    values = rng.normal(size=6) + 4.0
    law = fit_control_law(values, POINTS, LIBRARY, max_terms=3)
    theta = LIBRARY.evaluate(POINTS) / np.linalg.norm(LIBRARY.evaluate(POINTS), axis=0)

    def left_out(columns: np.ndarray) -> np.ndarray:
        rest = [np.arange(6) != k for k in range(6)]
        coef = [np.linalg.lstsq(columns[r], values[r], rcond=None)[0] for r in rest]
        return values - (columns * coef).sum(axis=1)

    every = {}
    for size in (1, 2, 3):
        for support in combinations(range(6), size):
            columns = theta[:, support]
            # Where one point alone decides a coefficient, the others cannot predict it.
            if min(np.linalg.matrix_rank(np.delete(columns, k, axis=0)) for k in range(6)) == size:
                every[tuple(LIBRARY.names[j] for j in support)] = np.abs(left_out(columns))
    least = min(every.values(), key=np.mean)
    alike = [  # within one standard error of the least, point by point
        names
        for names, errors in every.items()
        if np.mean(errors - least) <= np.std(errors - least, ddof=1) / np.sqrt(6)
    ]
    best = min(alike, key=lambda names: (len(names), every[names].mean()))
    assert law.functions.names == best
    error = np.sqrt(np.mean(every[best] ** 2)) / abs(values.mean())
    assert law.loo_error == pytest.approx(error, rel=1e-6)


def test_the_search_is_assessed_by_points_it_never_saw() -> None:
    values = np.random.default_rng(3).normal(size=6) + 4.0
    law = fit_control_law(values, POINTS, LIBRARY)
    errors = []
    for k in range(6):
        others = fit_control_law(np.delete(values, k), np.delete(POINTS, k, axis=0), LIBRARY)
        errors.append(values[k] - others.predict(POINTS[[k]])[0])
    assert law.search_error == pytest.approx(np.sqrt(np.mean(np.square(errors))) / values.mean())


def test_units_of_quantity_and_parameters_change_nothing_else() -> None:
    rng = np.random.default_rng(1)
    values = 0.02 + 3e-3 * POINTS[:, 1] + 1e-3 * rng.normal(size=6)
    here = fit_control_law(values, POINTS, LIBRARY)
    there = fit_control_law(1e25 * values, POINTS * [1e-3, 1e-6], LIBRARY)
    assert here.functions.names == there.functions.names
    assert there.loo_error == pytest.approx(here.loo_error)
    assert there.predict(POINTS * [1e-3, 1e-6]) == pytest.approx(1e25 * here.predict(POINTS))


@pytest.mark.parametrize(("n_points", "most"), [(3, 1), (5, 1), (6, 2), (8, 2), (9, 3)])
def test_a_law_has_one_term_for_every_three_points(n_points: int, most: int) -> None:
    points = np.random.default_rng(0).uniform(1.0, 2.0, size=(n_points, 2))
    values = LIBRARY.evaluate(points) @ [1.0, -2.0, 3.0, 0.5, -1.0, 2.0]  # of six terms
    law = fit_control_law(values, points, LIBRARY)
    alike = fit_control_law(values, points, LIBRARY, max_terms=most)
    assert law.functions.names == alike.functions.names
    largest = fit_control_law(values, points, LIBRARY, max_terms=6)
    assert len(law.functions) <= most <= len(largest.functions) <= n_points - 2


def test_a_term_that_one_point_alone_decides_is_out() -> None:
    points = np.array([[0.0], [0.0], [0.0], [0.0], [1.0]])
    law = fit_control_law(np.array([1.0, 1.1, 0.9, 1.0, 5.0]), points, polynomial(["x"], degree=1))
    assert law.functions.names == ("1",)  # with x the last point fits exactly, and says nothing


def test_what_cannot_make_a_law_is_refused() -> None:
    with pytest.raises(ValueError, match="a law needs three points or more"):
        fit_control_law(np.ones(2), POINTS[:2], LIBRARY)
    with pytest.raises(ValueError, match="'V_D_V' is 300 at all 4 operating points"):
        fit_control_law(np.ones(4), POINTS[1:5], LIBRARY)
