"""The sampler of benchmarks/source_search.py: its numbers, and the sets that it prints."""

import pytest

from benchmarks.source import measured_sets
from benchmarks.source_search import (
    BOUNDS,
    MEASURES,
    N_RUNS,
    append,
    from_unit,
    numbers_of,
    print_front,
    thruster_of,
    to_unit,
)


def test_a_set_comes_back_from_its_numbers():
    thruster, u_n = measured_sets()["lif"]
    numbers = from_unit(to_unit(numbers_of(thruster, u_n)))
    assert numbers_of(thruster_of(numbers, 300.0), u_n) == pytest.approx(numbers)
    assert numbers["u_n"] == pytest.approx(u_n)
    moved = thruster_of(numbers | {"drift": 2.0}, 200.0).transport.distance
    assert moved == pytest.approx([place - 2e-3 for place in thruster.transport.distance])


def test_the_front_lacks_what_is_beaten_and_what_has_two_cycles(tmp_path, capsys):
    measures = dict.fromkeys(MEASURES, 0.0) | {"runs": float(N_RUNS)}
    known = {
        "slow": {"miss_km_s": 1.5, "grid": 0.001, "varies": 0.8},
        "fast": {"miss_km_s": 1.0, "grid": 0.02, "varies": 0.8},
        "beaten": {"miss_km_s": 1.6, "grid": 0.001, "varies": 0.9},
        "two cycles": {"miss_km_s": 0.1, "grid": 0.0, "varies": 0.5, "starts": 0.2},
        "given up": {"miss_km_s": 0.1, "runs": 3.0},
    }
    for k, each in enumerate(known.values()):
        append(tmp_path, dict.fromkeys(BOUNDS, 1.0) | measures | each | {"f_kHz": 101.0 + k})
    print_front(tmp_path)
    head, _, *rows = capsys.readouterr().out.splitlines()
    assert head == "5 sets tried, 4 in all runs, 3 have one cycle"
    assert [row.split()[MEASURES.index("f_kHz")] for row in rows] == ["101", "102"]
