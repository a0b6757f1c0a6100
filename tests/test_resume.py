"""Interrupted runs continue with their finished pieces, and find the same to the last bit."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from omegaconf import DictConfig

import ep2sindy as ep
from ep2sindy.runtime.files import cache_folder
from ep2sindy.runtime.kept_pieces import CachedWorkers, KeptPieces, PartDone
from ep2sindy.runtime.parallel import Loky, Serial
from ep2sindy.studies import benchmark, trace
from tests.programs import Computed, composed, computed
from tests.test_experiment_benchmark import TOYS
from tests.test_experiment_trace import glance, scope, signal


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The user's cache, and a folder to stand in."""
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setenv("EP2SINDY_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def squares_and_negatives(workers: CachedWorkers, done: list[int]) -> list[list[tuple[int, Any]]]:
    def square(n: int) -> np.ndarray:
        done.append(n)
        if n == 5 and len(done) == 3:
            raise KeyboardInterrupt
        return np.array([n * n])

    return [sorted(workers.run(square, [3, 4, 5])), sorted(workers.run(lambda n: -n, [1, 2]))]


def test_pieces_are_computed_once_over_all_calls(tmp_path: Path) -> None:
    done: list[int] = []
    with pytest.raises(KeyboardInterrupt):
        squares_and_negatives(CachedWorkers(Serial(), tmp_path / "a"), done)
    for _ in range(2):
        found = squares_and_negatives(CachedWorkers(Serial(), tmp_path / "a"), done)
        assert found == [[(0, 9), (1, 16), (2, 25)], [(0, -1), (1, -2)]]
    assert done == [3, 4, 5, 5]
    squares_and_negatives(CachedWorkers(Serial(), tmp_path / "b"), done)
    squares_and_negatives(CachedWorkers(Serial(), None), done)
    assert len(done) == 10


@pytest.mark.parametrize("order", [[1, 2, 3], [3, 1, 2]])
def test_the_last_part_continues_with_the_pieces_of_all(tmp_path: Path, order: list[int]) -> None:
    done: list[int] = []

    def run(part: list[int] | None) -> list[list[tuple[int, int]]]:
        def square(n: int) -> int:
            done.append(n)
            return n * n

        workers = CachedWorkers(Serial(part), tmp_path)
        return [sorted(workers.run(square, numbers)) for numbers in (range(8), range(2))]

    for k in order[:2]:
        with pytest.raises(PartDone, match=rf"part {k} of 3 is done.* pieces of other parts"):
            run([k, 3])
        assert done == [*range(k - 1, 8, 3)]
        done.clear()
    whole = [[(n, n * n) for n in range(8)], [(0, 0), (1, 1)]]
    assert run([order[2], 3]) == whole
    assert done == [*range(order[2] - 1, 8, 3), 0, 1]
    assert run(None) == run([1, 3]) == whole
    assert len(done) == len([*range(order[2] - 1, 8, 3)]) + 2


def test_parts_without_a_folder_are_refused() -> None:
    with pytest.raises(ValueError, match="where none are kept: set parallel.part"):
        list(CachedWorkers(Serial([1, 2]), None).run(abs, [1]))


def test_workers_in_other_processes_share_the_pieces(tmp_path: Path) -> None:
    first = sorted(CachedWorkers(Loky(2), tmp_path).run(lambda n: (n, os.getpid()), [1, 2]))
    assert sorted(CachedWorkers(Serial(), tmp_path).run(lambda n: (n, 0), [1, 2])) == first
    assert all(process != os.getpid() for _, (_, process) in first)


def test_a_discovery_is_read_back_bit_for_bit(tmp_path: Path) -> None:
    run = ep.lotka_volterra().trajectory(noise=0.01, rng=0)
    found, back = (CachedWorkers(Serial(), tmp_path).once(lambda: ep.discover(run)) for _ in "ab")
    assert repr(back) == repr(found)
    assert back.model.coef.tobytes() == found.model.coef.tobytes()


def test_a_damaged_piece_is_computed_again(tmp_path: Path) -> None:
    assert CachedWorkers(Serial(), tmp_path).once(lambda: 7) == 7
    (stored,) = tmp_path.rglob("output.pkl")
    stored.write_bytes(b"cut")
    assert CachedWorkers(Serial(), tmp_path).once(lambda: 8) == 8


def test_pieces_of_a_run_that_nobody_took_up_are_removed(cache: Path) -> None:
    for key, days in (("old", 31.0), ("young", 29.0)):
        folder = cache_folder("pieces", key)
        folder.mkdir()
        then = folder.stat().st_mtime - 86400.0 * days
        os.utime(folder, (then, then))
    cache_folder("pieces", "new")
    assert [each.name for each in (cache / "pieces").iterdir()] == ["young"]


def ends(*_: object, **settings: object) -> None:
    raise KeyboardInterrupt


def broken_and_resumed(
    monkeypatch: pytest.MonkeyPatch, config: DictConfig, *, after: int
) -> Computed:
    """A run that ends after some pieces, as by Ctrl-C, and continues: those are not done again."""
    write, written = KeptPieces.write, list[tuple[int, int]]()

    def last(kept: KeptPieces, number: int, result: Any) -> None:
        if len(written) == after:
            raise KeyboardInterrupt
        written.append((kept.call, number))
        write(kept, number, result)

    def others(kept: KeptPieces, number: int, result: Any) -> None:
        assert (kept.call, number) not in written
        write(kept, number, result)

    monkeypatch.setattr(KeptPieces, "write", last)
    with pytest.raises(KeyboardInterrupt):
        computed(config)
    monkeypatch.setattr(KeptPieces, "write", others)
    return computed(config)


def check_same(whole: Computed, rest: Computed) -> None:
    times = ["cpu_s", "cpu_s_per_search"]
    assert "going on with the pieces that an earlier run has kept" in rest.log
    assert "going on with" not in whole.log
    for name, table in whole.report.tables.items():
        pair = table, rest.report.tables[name]
        tables = [each.drop(columns=times, errors="ignore") for each in pair]
        pd.testing.assert_frame_equal(*tables, check_exact=True)
    for name, model in whole.report.models.items():
        assert model.coef.tobytes() == rest.report.models[name].coef.tobytes()


@pytest.mark.parametrize("name", TOYS)
def test_benchmarks_go_on(name: str, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = composed(f"+exp={name}", *TOYS[name], "parallel=serial")
    whole = computed(config)
    check_same(whole, broken_and_resumed(monkeypatch, config, after=3))
    assert not list(cache.rglob("output.pkl"))  # removed once all is written


@pytest.mark.slow
def test_a_trace_that_ends_in_its_tests_searches_once(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = composed(*glance(scope(tmp_path / "scope.csv", *signal(12.0)), tmp_path))
    whole = computed(config)
    with monkeypatch.context() as patched:
        patched.setattr(trace, "run_on_rest", ends)
        with pytest.raises(KeyboardInterrupt):
            computed(config)
    check_same(whole, computed(config))


def test_other_settings_begin_anew(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = [
        "+exp=benchmark", "systems=[oscillator]", "noises=[0.0]", "n_realizations=3",
        "variants=[STLSQ]", "parallel=serial",
    ]  # fmt: skip
    monkeypatch.setattr(benchmark, "cells", ends)
    for more in ([], ["seed=1"], ["verbose=true"], ["output=elsewhere"]):
        with pytest.raises(KeyboardInterrupt):
            computed(composed(*given, *more))
    assert len(list(cache.rglob("output.pkl"))) == 6


def test_where_no_cache_can_be_written_a_run_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EP2SINDY_CACHE", "~/.cache")
    given = ["systems=[oscillator]", "noises=[0.0]", "n_realizations=1", "variants=[STLSQ]"]
    found = computed(composed("+exp=benchmark", *given, "parallel=serial"))
    assert "finished pieces are not kept: a cache needs an absolute folder" in found.log
    assert not Path("~").exists()
