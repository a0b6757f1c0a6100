"""Runs that are broken off go on with their finished pieces, and find the same to the last bit."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from omegaconf import DictConfig

import ep2sindy as ep
from ep2sindy.runtime.kept import (
    TREE,
    Kept,
    KeptWorkers,
    Piece,
    UnpackableError,
    packed,
    unpacked,
)
from ep2sindy.runtime.parallel import Serial
from ep2sindy.studies import trace
from tests.programs import Computed, composed, computed
from tests.test_experiment_trace import glance, scope, signal
from tests.test_file_names import swing


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


RUN = ep.lotka_volterra().trajectory(noise=0.01, rng=0)


@pytest.mark.parametrize("method", [None, ep.Regression(search=ep.BestSubset())])
def test_a_discovery_is_packed_and_read_back_bit_for_bit(method: ep.Regression | None) -> None:
    found = ep.discover(RUN, method=method)
    arrays = packed(found)
    back = unpacked(arrays)
    assert type(back) is type(found)
    assert repr(back) == repr(found)
    np.testing.assert_array_equal(back.model.coef, found.model.coef)
    again = packed(back)
    assert {name: each.tobytes() for name, each in again.items()} == {
        name: each.tobytes() for name, each in arrays.items()
    }


def test_a_library_keeps_its_functions_by_their_names() -> None:
    library = ep.polynomial(["x"], functions=["sin(2*x)"])
    back = unpacked(packed(library))
    assert back.names == library.names
    assert back.functions[0].kind is library.functions[0].kind


def test_what_is_shared_stays_shared_and_locked_stays_locked() -> None:
    row = np.arange(6.0).reshape(2, 3)
    value = {"a": [row, row], "b": (row.T.copy(order="F"), np.float64(np.nan), 1.5, None)}
    value["c"] = {1: frozenset({"x"}), "k": range(2, 8, 3)}
    row.flags.writeable = False
    back = unpacked(packed(value))
    assert back["a"][0] is back["a"][1]
    assert not back["a"][0].flags.writeable
    assert back["b"][0].flags.f_contiguous
    assert back["c"] == value["c"]
    assert type(back["b"][1]) is np.float64


class OutsideOfThePackage:
    pass


@pytest.mark.parametrize(
    "value", [lambda x: x, OutsideOfThePackage(), np.array([None]), [print], Path("a")]
)
def test_what_cannot_be_written_down_is_refused(value: object) -> None:
    with pytest.raises(UnpackableError, match="cannot be written down"):
        packed(value)


@pytest.mark.parametrize(
    "tree",
    [
        '{"tree": {"object": 0}, "objects": [{"class": "os:system", "state": {}}]}',
        '{"tree": {"object": 0}, "objects": [{"class": "ep2sindy.runtime.files:os.system", '
        '"state": {}}]}',
        '{"tree": {"object": 0}, "objects": [{"class": "ep2sindy.runtime.kept:Kept", '
        '"state": {"path": 1}}]}',
        '{"tree": {"object": 0}, "objects": [{"class": "ep2sindy.runtime.files:WriteError", '
        '"state": {}}]}',
        '{"tree": {"enum": ["subprocess:Popen", "x"]}, "objects": []}',
        '{"tree": {"call": 1}, "objects": []}',
        '{"tree": {"array": [3, true]}, "objects": []}',
        "{",
    ],
)
def test_a_file_of_a_stranger_runs_nothing(tree: str) -> None:
    with pytest.raises(ValueError, match="a packed value must be as it was written"):
        unpacked({TREE: np.array(tree)})


@dataclass
class Counted:
    """Workers that stop after so many pieces, as by Ctrl-C, and count what they compute."""

    stop_after: int | None = None
    computed: list[Any] = field(default_factory=list)

    def run(self, function: Callable[[Any], Any], pieces: Any) -> Iterator[tuple[int, Any]]:
        def one(piece: Any) -> Any:
            if self.stop_after is not None and len(self.computed) >= self.stop_after:
                raise KeyboardInterrupt
            self.computed.append(piece)
            return function(piece)

        return Serial().run(one, pieces)


def test_pieces_are_computed_once_over_all_calls(tmp_path: Path) -> None:
    def both(workers: KeptWorkers) -> list[list[tuple[int, Any]]]:
        squares = sorted(workers.run(lambda n: np.array([n * n]), [3, 4, 5]))
        return [squares, sorted(workers.run(lambda n: -n, [1, 2]))]

    first = Counted(stop_after=4)
    with pytest.raises(KeyboardInterrupt):
        both(KeptWorkers(first, Kept(tmp_path, "a")))
    assert first.computed == [3, 4, 5, 1]
    second = Counted()
    found = both(KeptWorkers(second, Kept(tmp_path, "a")))
    assert second.computed == [2]
    assert found == [[(0, 9), (1, 16), (2, 25)], [(0, -1), (1, -2)]]
    other = Counted()
    both(KeptWorkers(other, Kept(tmp_path, "b")))
    assert len(other.computed) == 5


def test_a_piece_that_cannot_be_kept_is_computed_again_and_named(tmp_path: Path) -> None:
    for _ in range(2):
        workers = KeptWorkers(Serial(), Kept(tmp_path, "a"))
        assert workers.once(lambda: print) is print
        assert [*workers.refused] == [
            "a builtins.builtin_function_or_method cannot be written down"
        ]


def test_a_damaged_piece_is_computed_again(tmp_path: Path) -> None:
    kept = Kept(tmp_path, "a")
    kept.write(Piece("0_0"), {TREE: np.array("{")})
    workers = Counted()
    assert list(KeptWorkers(workers, kept).run(lambda n: n, [7])) == [(0, 7)]
    assert workers.computed == [7]


def break_off(monkeypatch: pytest.MonkeyPatch, config: DictConfig, after: int) -> None:
    """Run until so many pieces are written, and end as by Ctrl-C."""
    write, written = Kept.write, []

    def last(self: Kept, piece: Piece, done: dict) -> None:
        if len(written) == after:
            raise KeyboardInterrupt
        write(self, piece, done)
        written.append(piece.name)

    with monkeypatch.context() as patched:
        patched.setattr(Kept, "write", last)
        with pytest.raises(KeyboardInterrupt):
            computed(config)


def count_writes(monkeypatch: pytest.MonkeyPatch, config: DictConfig) -> tuple[int, Computed]:
    write, written = Kept.write, []

    def counted(self: Kept, piece: Piece, done: dict) -> None:
        written.append(piece.name)
        write(self, piece, done)

    with monkeypatch.context() as patched:
        patched.setattr(Kept, "write", counted)
        found = computed(config)
    return len(written), found


def check_resumed(
    monkeypatch: pytest.MonkeyPatch, config_of: Callable[[str], DictConfig], *, after: int
) -> tuple[Computed, Computed]:
    """A whole run, and one that goes on after some pieces: those are not computed again."""
    n_whole, whole = count_writes(monkeypatch, config_of("whole"))
    break_off(monkeypatch, config_of("broken"), after)
    n_rest, rest = count_writes(monkeypatch, config_of("broken"))
    assert n_rest == n_whole - after > 0
    assert f"going on with {after} pieces that a broken run had done" in rest.log
    assert "going on with" not in whole.log
    return whole, rest


def check_same(whole: Computed, rest: Computed) -> None:
    first, second = whole.outcome.tables(), rest.outcome.tables()
    assert set(first) == set(second)
    for name, table in first.items():
        pd.testing.assert_frame_equal(table, second[name], check_exact=True)
    models = whole.outcome.models(), rest.outcome.models()
    for name, model in models[0].items():
        assert model.coef.tobytes() == models[1][name].coef.tobytes()


def test_a_benchmark_goes_on(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def config(keep: str) -> DictConfig:
        return composed(
            "+exp=benchmark", "systems=[oscillator,lotka_volterra]", "noises=[0.0,0.05]",
            "n_realizations=2", "variants=[STLSQ,ours]", "parallel=serial", f"keep={keep}",
        )  # fmt: skip

    whole, rest = check_resumed(monkeypatch, config, after=3)
    columns = ["cpu_s", "cpu_s_per_search"]
    for name, table in whole.outcome.tables().items():
        there = rest.outcome.tables()[name].drop(columns=columns, errors="ignore")
        pd.testing.assert_frame_equal(
            table.drop(columns=columns, errors="ignore"), there, check_exact=True
        )


def test_a_prediction_goes_on(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    swing(folder, 0.6, 0.9, 1.2)

    def config(keep: str) -> DictConfig:
        return composed(
            "+exp=predict", "data=recognised", "points.files=a{a}.csv", "~models",
            "+models.own.terms={n_i: [n_i,n_n,'n_i^3'], n_n: [n_i]}", "degrees=[1]",
            "windows.n_windows=4", "map_points=2", "forecasts=2", "parallel=serial", f"keep={keep}",
        )  # fmt: skip

    whole, rest = check_resumed(monkeypatch, config, after=5)
    check_same(whole, rest)


@pytest.mark.slow
def test_a_trace_goes_on(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A signal that does not repeat itself is tried in two states, and in three."""
    run = ep.lorenz().trajectory().window(0, 2400)
    path = scope(folder / "scope.csv", run.t, run.states[:, 0])

    def config(keep: str) -> DictConfig:
        return composed(*glance(path, folder, "degree=2", "embedding=rate", f"keep={keep}"))

    whole, rest = check_resumed(monkeypatch, config, after=1)
    check_same(whole, rest)


def test_a_trace_that_ends_in_its_tests_searches_once(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = scope(folder / "scope.csv", *signal(12.0))

    def config(keep: str) -> DictConfig:
        return composed(*glance(path, folder, f"keep={keep}"))

    def ends(*_: object, **settings: object) -> None:
        raise KeyboardInterrupt

    whole = computed(config("whole"))
    with monkeypatch.context() as patched:
        patched.setattr(trace, "evaluate", ends)
        with pytest.raises(KeyboardInterrupt):
            computed(config("broken"))
    n, rest = count_writes(monkeypatch, config("broken"))
    assert n == 0
    check_same(whole, rest)
    assert not list((folder / "broken").rglob("*.npz"))  # removed once all is written


def test_other_settings_begin_anew_and_say_so(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def config(*more: str) -> DictConfig:
        return composed(
            "+exp=benchmark", "systems=[oscillator]", "noises=[0.0]", "n_realizations=3",
            "variants=[STLSQ]", "parallel=serial", "keep=kept", *more,
        )  # fmt: skip

    break_off(monkeypatch, config(), 2)
    n, found = count_writes(monkeypatch, config("seed=1"))
    assert n == 3
    assert "this run begins anew: what is kept in kept of 1 other run was made by" in found.log
    n, found = count_writes(monkeypatch, config("verbose=true", "output=elsewhere"))
    assert n == 1
