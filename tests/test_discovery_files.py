"""A discovery that is stored says all that it said, and a file from someone else runs nothing."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.data.trajectory import Trajectory

THESIS = ep.Regression(ep.Differential(), ep.AdaptiveLasso(), ep.Knee(), ep.Bootstraps(n=4))
TIED = ep.polynomial(["x", "y"]).relate("x: x*y == -1 * y: x*y")
CASES: dict[str, dict[str, Any]] = {
    "trajectories": {"method": ep.TrajectorySearch(max_terms=3)},
    "regression": {"method": ep.Regression(), "library": TIED},
    "bootstraps": {"method": THESIS},
    "runs": {"method": ep.Regression(selection=ep.FreeRunScore(assessed=("x",), n_windows=4))},
}


def record() -> Trajectory:
    return ep.lotka_volterra().trajectory(noise=0.02, rng=0)


@cache
def found(case: str) -> ep.Discovery:
    return ep.discover(record(), **CASES[case])


@pytest.mark.parametrize("case", CASES)
def test_a_discovery_comes_back_as_it_was(case: str, tmp_path: Path) -> None:
    known = found(case)
    known.save(tmp_path / "found.json")
    again = ep.Discovery.load(tmp_path / "found.json")
    assert again.model == known.model
    assert again.method == known.method
    assert again.noise_test.lack_of_fit == known.noise_test.lack_of_fit
    assert again.to_json() == known.to_json()
    assert repr(again) == repr(known)
    for state, front in known.fronts.items():
        assert repr(again.fronts[state]) == repr(front)
        assert np.array_equal(again.scores[state], known.scores[state], equal_nan=True)


def test_a_constraint_that_was_stored_serves_a_refinement() -> None:
    known = found("regression")
    again = ep.Discovery.from_json(known.to_json())
    assert again.constraint is not None
    settings = ep.refinement.RefinementSettings(n_windows=3, window=30)
    one, other = (
        ep.refine(each.model, record(), settings, constraint=each.constraint).model
        for each in (known, again)
    )
    assert one == other


def test_rows_are_not_stored_and_who_needs_them_is_told() -> None:
    again = ep.Discovery.from_json(found("bootstraps").to_json())
    assert again.estimate is None
    with pytest.raises(ValueError, match="a discovery that was stored keeps none"):
        again.fronts["x"].rows  # noqa: B018


class Own:
    selection = ep.discovery.Evidence()

    def identify(self, task: Any, *, rng: Any, progress: Any) -> Any:
        return ep.TrajectorySearch(max_terms=2).identify(task, rng=rng, progress=progress)


def test_a_method_of_ones_own_is_refused_with_the_way_out() -> None:
    own = replace(found("trajectories"), method=Own())
    with pytest.raises(ValueError, match=r"classes of this package alone, got .*found.model.save"):
        own.to_json()


def test_a_discovery_does_what_its_model_does() -> None:
    known, run = found("trajectories"), record()
    t, start = run.t[:50], run.states[0]
    assert np.array_equal(known.simulate(t, start).states, known.model.simulate(t, start).states)
    assert known.score(run) == known.model.score(run)


BAD: list[tuple[dict[str, Any], str]] = [
    ({"format": "ep2sindy.SparseModel/1"}, "format 'ep2sindy.SparseModel/1'"),
    ({"model": {}}, "a model file must hold"),
    ({"method": {"class": "os.system"}}, "no class 'os.system' may stand"),
    ({"method": {"class": "ep2sindy.EBIC"}}, "method of another kind: EBIC"),
    ({"fronts": {"mapping": []}, "chosen": {"mapping": []}}, "fronts and candidates of other"),
    ({"fronts": {"mapping": [["x", {"array": [], "type": "object"}]]}}, "an array of type"),
    # What Python itself says of a value without a part, or with one too many, names only code.
    ({"data_warnings": 1}, "JSON: it is damaged, or of another kind"),
]


@pytest.mark.parametrize(("change", "message"), BAD)
def test_a_discovery_that_cannot_be_is_refused(change: dict[str, Any], message: str) -> None:
    content = json.loads(found("trajectories").to_json()) | change
    with pytest.raises(ValueError, match=r"a discovery must be .* JSON: .*") as caught:
        ep.Discovery.from_json(json.dumps(content))
    assert caught.match(message)


@pytest.mark.parametrize("text", ["", "[]", "1", "[" * 100_000, "{}", "\0"])
def test_text_that_is_no_discovery_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="a discovery must be"):
        ep.Discovery.from_json(text)


def test_candidates_of_unknown_terms_are_refused() -> None:
    text = found("trajectories").to_json()
    with pytest.raises(ValueError, match="a candidate that is no equation of x"):
        ep.Discovery.from_json(text.replace('"x*y"\n     ]', '"x*q"\n     ]', 1))


def test_a_discovery_says_what_is_said_of_its_model_also_once_it_is_read() -> None:
    noise = np.random.default_rng(0).standard_normal((20, 2))
    nothing = ep.discover((np.arange(20.0), noise))
    assert repr(nothing).startswith("Discovery: no equations found")
    found = ep.discover(ep.lotka_volterra().trajectory(noise=0.02, rng=0))
    assert repr(found).startswith("Discovery of 2 equations: follows the samples for 99.9 s\n")
    again = ep.Discovery.from_json(found.to_json())
    assert again.evaluation is None
    assert again.verdict == found.verdict == "follows the samples for 99.9 s"


@pytest.mark.parametrize("how", [{}, {"shared": True}, {"law": 1}])
def test_at_several_points_it_says_at_how_many(how) -> None:
    runs = [
        replace(ep.lotka_volterra(a=a).trajectory(noise=0.02, rng=0), parameters={"a": a})
        for a in (0.5, 0.8, 1.1)
    ]
    found = ep.discover(runs, method=ep.Regression(), **how)
    assert found.verdict == "follows the samples at 3 of 3"
    again = ep.Discovery.from_json(found.to_json())
    assert again.verdict == found.verdict
