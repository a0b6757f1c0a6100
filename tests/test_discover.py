from dataclasses import replace

import numpy as np
import pytest

from ep2sindy.data.coerce import DiscoveryProblem
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.datasets.records import hare_lynx
from ep2sindy.discovery import choice
from ep2sindy.discovery.discover import discover
from ep2sindy.discovery.method import AnyMethod, Regression, TrajectorySearch
from ep2sindy.library.library import named_terms, polynomial
from ep2sindy.library.names import split_factors
from ep2sindy.library.relations import relations_of
from ep2sindy.regression.bootstraps import Bootstraps
from ep2sindy.regression.formulations import Differential, Weak, WeightedWeak
from ep2sindy.regression.front import Candidate, ParetoFront
from ep2sindy.regression.rows import Formulation, RegressionRows
from ep2sindy.regression.searches import AdaptiveLasso, BestSubset
from ep2sindy.selection.criteria import EBIC, Knee, combinations
from ep2sindy.selection.free_run import FreeRunScore
from ep2sindy.systems.systems import lotka_volterra, van_der_pol
from tests.rules import BySize

PELTS = Trajectory(np.arange(1900.0, 1921.0), hare_lynx().states, ["hare", "lynx"])  # in years

RECIPE = Regression(Differential(), AdaptiveLasso(), Knee("library"), Bootstraps(n=8))
PLAIN = Regression(Differential(), BestSubset(), bootstraps=Bootstraps(n=0))
RECIPES = [Regression(WeightedWeak()), PLAIN]


def test_predator_and_prey_are_found_in_noisy_data() -> None:
    system = lotka_volterra()
    run = system.trajectory(noise=0.01, rng=np.random.default_rng(0))
    found = discover([run], polynomial(["x", "y"], degree=2), RECIPE, seed=1)
    for state in ("x", "y"):
        truth, terms = system.model.terms(state), found.model.terms(state)
        assert set(terms) == set(truth)
        assert [terms[k] for k in truth] == pytest.approx(list(truth.values()), rel=0.02)
    assert "AdaptiveLasso" in found.model.provenance["search"]


def test_two_trajectories_of_different_length_are_one_problem() -> None:
    system = lotka_volterra()
    first = system.trajectory()
    second = system.trajectory(initial=np.array([0.3, 1.2])).window(0, 400)
    found = discover([first, second], polynomial(["x", "y"], degree=2), RECIPE, seed=1)
    assert found.model.terms("x") == pytest.approx({"x": 2 / 3, "x*y": -1.0}, rel=0.01)


def test_rescaling_units_rescales_coefficients_and_nothing_else() -> None:
    run = lotka_volterra().trajectory(noise=0.02, rng=np.random.default_rng(0))
    scale, tempo = np.array([1e18, 3e-14]), 1e-5
    rescaled = Trajectory(t=run.t * tempo, states=run.states * scale, state_names=["x", "y"])
    library = polynomial(["x", "y"], degree=2)
    plain = discover([run], library, RECIPE, seed=1)
    other = discover([rescaled], library, RECIPE, seed=1)
    unit = (scale**library.exponents).prod(axis=1)[:, None]
    assert other.model.coef * unit * tempo / scale == pytest.approx(plain.model.coef, rel=1e-9)
    for state, front in plain.fronts.items():
        assert [c.terms for c in front.candidates] == [
            c.terms for c in other.fronts[state].candidates
        ]
        assert other.fronts[state].errors == pytest.approx(front.errors, rel=1e-9)


def test_permuting_the_library_changes_nothing() -> None:
    run = lotka_volterra().trajectory(noise=0.02, rng=np.random.default_rng(0))
    recipe = replace(RECIPE, search=BestSubset(), bootstraps=Bootstraps(n=0))
    forth = discover([run], polynomial(["x", "y"], degree=2), recipe, seed=1)
    back = discover([run], polynomial(["y", "x"], degree=2), recipe, seed=1)
    for state in ("x", "y"):
        terms = {frozenset(split_factors(t)): c for t, c in forth.model.terms(state).items()}
        permuted = {frozenset(split_factors(t)): c for t, c in back.model.terms(state).items()}
        assert len(terms) == 2
        assert permuted == pytest.approx(terms, rel=1e-9)


@pytest.mark.parametrize("recipe", [None, RECIPES[0]], ids=["joint", "regression"])
def test_hare_and_lynx_are_predator_and_prey_in_21_counts(recipe: AnyMethod | None) -> None:
    """Least squares of whole trajectories gives 0.481, 0.0248, 0.926 and 0.0275."""
    found = discover(PELTS, None, recipe)
    truth = {"hare": {"hare": 0.481, "hare*lynx": -0.0248}}
    truth["lynx"] = {"lynx": -0.926, "hare*lynx": 0.0275}
    for state, terms in truth.items():
        assert found.model.terms(state) == pytest.approx(terms, rel=0.05)
    run = found.model.rollout(PELTS)
    assert not run.diverged
    assert run.states.max() < 2.0 * PELTS.states.max()


def test_an_equation_that_is_given_is_not_held_down() -> None:
    given = ["1", "hare", "lynx"]
    known = {"hare": given, "lynx": ["lynx", "hare*lynx"]}
    found = discover(PELTS, polynomial(PELTS.names).only(known), Regression(WeightedWeak()))
    assert set(found.model.terms("hare")) == set(given)
    assert not any("rows are few" in a.message for a in found.ambiguities)


@pytest.mark.parametrize("recipe", RECIPES, ids=["weighted", "differential"])
def test_what_an_equation_leaves_tells_whether_a_term_is_missing(recipe: AnyMethod) -> None:
    run = lotka_volterra().trajectory(noise=0.05, rng=0)
    full = polynomial(["x", "y"], degree=2)
    found = discover(run, full, recipe)
    assert list(found.noise_test.left) == ["x", "y"]
    for left in found.noise_test.left.values():
        assert left.chi_squared == pytest.approx(1.0, abs=0.3)
        assert left.autocorrelation == pytest.approx(0.0, abs=0.2)
        assert left.leaves_noise
    assert found.lack_of_fit == ""
    if recipe is not PLAIN:  # whose rows know nothing of their noise
        low, high = found.model.intervals("x")["x*y"]
        assert low < found.model.terms("x")["x*y"] < high < low + 0.1
    lacking = discover(run, full.take(np.array(full.names) != "x*y"), recipe)
    left = lacking.noise_test.left.values()
    assert not any(each.leaves_noise for each in left)
    assert min(each.autocorrelation for each in left) > 0.3
    assert "% of x' (noise alone: " in lacking.lack_of_fit
    assert lacking.lack_of_fit in lacking.note
    assert lacking.model.covariance is None


def test_an_equation_without_terms_is_a_lack_of_fit_where_its_state_moves() -> None:
    run = lotka_volterra().trajectory(noise=0.05, rng=0)
    only_one = polynomial(["x", "y"], degree=0)
    rule = EBIC(gamma=0.0, coarsening=None)
    found = discover(run, only_one, replace(PLAIN, selection=rule))
    assert {chosen.terms for chosen in found.chosen.values()} == {()}
    assert "x'" in found.lack_of_fit


FORMS = [Differential(), Weak(), WeightedWeak()]


@pytest.mark.parametrize("formulation", FORMS, ids=["differential", "weak", "weighted"])
def test_relations_that_the_data_contradict_are_a_lack_of_fit(formulation: Formulation) -> None:
    run = lotka_volterra().trajectory(noise=0.05, rng=0)
    recipe, library = Regression(formulation), polynomial(["x", "y"])
    right = discover(run, library.relate("x: x*y == -1"), recipe)
    assert right.lack_of_fit == ""
    assert right.model.covariance is not None
    wrong = discover(run, library.relate("x: x == 5"), recipe)
    assert wrong.model.terms("x")["x"] == 5.0
    assert not wrong.noise_test.left["x"].leaves_noise
    assert wrong.noise_test.left["y"].leaves_noise
    assert "unexplained, over 100 % of x' (noise alone: " in wrong.lack_of_fit
    assert "check the relations" in wrong.lack_of_fit
    assert wrong.model.covariance is None


@pytest.mark.parametrize(
    ("relations", "n_free"),
    [
        (["x: x*y == -1"], {"x": 1}),
        (["x: x*y == -1 * y: x*y"], {"x": 2, "y": 2}),
        (["x: x == 2 * y: x*y + y: y"], {"x": 2, "y": 2}),
        (["x: x == 0.7", "x: x*y == -1"], {"x": 0}),
    ],
)
def test_the_free_coefficients_of_related_equations_are_counted(
    relations: list[str], n_free: dict[str, int]
) -> None:
    run, library = lotka_volterra().trajectory(), named_terms(["x", "y"], ["x", "y", "x*y"])
    terms = {"x": ["x", "x*y"], "y": ["y", "x*y"]}
    task = DiscoveryProblem([run], library.relate(*relations).only(terms))
    found = Regression().identify(task, rng=np.random.default_rng(0))
    assert found.noise_test.n_free == n_free


def random_front(state: str, names: list[str], rng: np.random.Generator) -> ParetoFront:
    """Eight candidates of random terms and random scores, the empty one first."""
    supports = [[], *([n for n in names if rng.random() < 0.5] for _ in range(7))]
    ones = [np.ones(len(terms)) for terms in supports]
    pairs = zip(supports, ones, strict=True)
    candidates = [Candidate(state, tuple(terms), c, 0.0, 0.0, 0.0, c) for terms, c in pairs]
    return ParetoFront(state, candidates).with_scores(rng.normal(size=len(candidates)))


RELATED = [
    ["a: a == 1"],
    ["a: b == -1 * c: b"],
    ["a: b == -1 * c: b", "d: d == c: c"],
    ["a: b == -1 * c: b", "b: a == d: c", "d: 1 == 2"],
]


@pytest.mark.parametrize("relations", RELATED, ids=len)
@pytest.mark.parametrize("seed", range(5))
def test_fronts_that_no_relation_ties_are_chosen_one_by_one(
    relations: list[str], seed: int
) -> None:
    rng, related = np.random.default_rng(seed), relations_of(relations)
    fronts = [random_front(state, ["1", *"abcd"], rng) for state in "abcd"]
    every = combinations(fronts, 10_000, related)
    sums = [sum(f.scores[k] for f, k in zip(fronts, place, strict=True)) for place in every]
    found = choice._least_sum(fronts, related)
    assert found.tolist() == every[int(np.argmin(sums))].tolist()


def test_the_number_of_states_is_limited_only_where_relations_tie_them() -> None:
    rng, names = np.random.default_rng(0), [f"s{k}" for k in range(8)]
    fronts = [random_front(name, names, rng) for name in names]
    two = choice._least_sum(fronts, relations_of(["s0: s1 == s1: s0"]))
    for k in range(2, 8):
        assert two[k] == np.argmin(fronts[k].scores)
    chain = relations_of([f"s{k}: s0 == s{k + 1}: s0" for k in range(7)])
    assert len(choice._least_sum(fronts, chain)) == 8
    never = relations_of(["s0: s0*s1 == 3"])
    with pytest.raises(ValueError, match="none of the best .* tie fewer states to each other$"):
        choice._least_sum(fronts, never)


def test_a_state_whose_rows_cannot_be_whitened_leaves_the_others_tested(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fail_for_x(problem: RegressionRows, fit: Candidate, *, negligible: float) -> Candidate:
        if fit.equation == "x":
            raise np.linalg.LinAlgError("singular")
        return reweight(problem, fit, negligible=negligible)

    reweight = choice.reweight
    monkeypatch.setattr(choice, "reweight", fail_for_x)
    found = discover(lotka_volterra().trajectory(noise=0.05, rng=0), None, PLAIN)
    assert list(found.noise_test.left) == ["y"]


def test_a_rule_that_assesses_free_runs_says_a_lack_of_fit_where_others_do() -> None:
    run = replace(lotka_volterra(), rate_Hz=5.0).trajectory(noise=0.05, rng=0)
    rule = FreeRunScore(n_windows=4, n_folds=2)
    recipe = Regression(WeightedWeak(), BestSubset(max_terms=2), rule, Bootstraps(n=0))
    found = discover(run, named_terms(["x", "y"], ["x", "y", "x*y"]), recipe)
    assert found.noise_test.tested
    assert found.lack_of_fit == ""
    poor = discover(run, named_terms(["x", "y"], ["x", "y"]), recipe)
    assert "% of x' (noise alone" in poor.lack_of_fit
    by_rows = discover(run, named_terms(["x", "y"], ["x", "y"]), replace(recipe, selection=EBIC()))
    assert "% of x' (noise alone" in by_rows.lack_of_fit


def test_the_test_of_a_trajectory_search_is_not_that_of_another_model() -> None:
    run = lotka_volterra().trajectory(noise=0.02, rng=0)
    library = named_terms(["x", "y"], ["x", "y", "x*y"])
    tested = discover(run, library, TrajectorySearch())
    assert tested.noise_test.tested
    still = discover(run, library, TrajectorySearch(selection=BySize(sign=1)))
    assert not still.model.coef.any()
    assert still.estimate.lack_of_fit == ""
    assert "unexplained, 100 % of x'" in still.lack_of_fit
    poor = discover(
        run, library.take(np.array([True, True, False])), TrajectorySearch(selection=BySize(sign=1))
    )
    assert poor.estimate.lack_of_fit
    assert "unexplained, 100 % of x'" in poor.lack_of_fit


def test_samples_too_few_for_weak_rows_are_assessed_by_none() -> None:
    run = lotka_volterra().trajectory(noise=0.05, rng=0)
    found = discover(run.window(0, 12), polynomial(["x", "y"], degree=1), PLAIN)
    assert found.lack_of_fit == ""


def noise_in_pieces(n: int, rng: np.random.Generator) -> list[Trajectory]:
    """White noise about a drift in x and about a rest in y."""
    t, states = np.arange(float(n)), rng.standard_normal((n, 2))
    states[:, 0] += 5.0 * t
    run = Trajectory(t, states, ["x", "y"])
    return [run.window(0, n // 2), run.window(n // 2, n)]


@pytest.mark.parametrize("recipe", [TrajectorySearch(), Regression(Weak()), *RECIPES], ids=repr)
def test_what_a_model_leaves_at_rest_must_be_white_noise_by_any_method(recipe: AnyMethod) -> None:
    """A noisy square wave of six samples to a turn, which rows take for noise."""
    n, rng = 120, np.random.default_rng(0)
    turns = np.sign(np.sin(np.arange(n))) + 0.1 * rng.standard_normal(n)
    run = Trajectory(np.arange(float(n)), turns[:, None], ["x"])
    constant = polynomial(["x"], degree=0)
    found = discover(run, constant, recipe)
    assert found.lack_of_fit
    assert found.note == found.lack_of_fit
    assert found.model.covariance is None
    few = replace(run, states=rng.standard_normal((n, 1))).window(0, 20)
    still = discover(few, constant, recipe)
    assert still.lack_of_fit == ""
    assert "20 are too few to tell" in still.note


def test_a_law_is_not_denied_for_the_ten_thousandth_that_it_leaves() -> None:
    system = van_der_pol(mu=0.5)
    run = system.trajectory(noise=1e-6, rng=0)
    found = discover(run, polynomial(["x", "y"], degree=3), Regression(WeightedWeak()))
    assert found.lack_of_fit == ""
    assert found.noise_test.left["x"].chi_squared > 10.0  # numerical errors
    for term, (low, high) in found.model.intervals("x").items():
        assert low < system.model.terms("x")[term] < high < low + 1e-5


def test_an_equation_that_says_what_a_state_is_is_not_denied() -> None:
    """v is not the rate of x here, but known is known; the other equation is denied."""
    t = 0.1 * np.arange(400)
    noise = 0.01 * np.random.default_rng(0).standard_normal((400, 2))
    run = Trajectory(t, noise + np.stack([np.cos(t), np.sin(3.0 * t)], axis=1), ["x", "v"])
    library = polynomial(["x", "v"], degree=1).only({"x": ["v"], "v": ["v"]})
    found = discover(run, library.relate("x: v == 1"), Regression(WeightedWeak()))
    assert found.model.terms("x") == {"v": 1.0}
    assert list(found.noise_test.left) == ["v"]


@pytest.mark.parametrize("recipe", [TrajectorySearch(), RECIPES[0]], ids=["joint", "regression"])
def test_white_noise_about_a_steady_course_is_no_law(recipe: AnyMethod) -> None:
    runs = noise_in_pieces(160, np.random.default_rng(1))
    found = discover(runs, polynomial(["x", "y"], degree=0), recipe)
    assert found.lack_of_fit == ""
    assert found.noise_test.note in found.note
    assert "no law of x and y is found" in found.note
    assert "too few" not in found.note


def test_a_rest_is_assessed_by_the_instants_at_which_all_was_measured() -> None:
    t, rng = np.arange(200.0), np.random.default_rng(2)
    states = np.stack([np.cos(0.7 * t), rng.standard_normal(200)], axis=1)
    missing = np.zeros((200, 2), dtype=np.bool_)
    missing[::3, 1] = True
    run = Trajectory(t, states, ["x", "y"], missing=missing)
    found = discover(run, polynomial(["x", "y"], degree=0), PLAIN)
    assert "leaves x at rest" in found.lack_of_fit or "% of x'" in found.lack_of_fit
