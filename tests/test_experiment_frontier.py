from pathlib import Path

from tests.programs import composed, computed


def test_frontier_runs_at_toy_size(tmp_path: Path) -> None:
    overrides = ["variants=[STLSQ,ours]", "rates_Hz=[1,20]", "durations_s=[5,40]"]
    config = composed("+exp=frontier", "parallel=serial", *overrides, f"output={tmp_path}")
    frontier = computed(config)
    points = frontier.summary["points"]
    assert len(points) == 8
    found = {(p["variant"], p["rate_Hz"], p["duration_s"]): p["identified"] for p in points}
    assert found["STLSQ", 20.0, 40.0]
    assert found["ours", 20.0, 40.0]
    assert not found["STLSQ", 1.0, 5.0]
    assert "STLSQ 1" in frontier.page  # too few samples to smooth
    frontier.check_figures("frontier")
