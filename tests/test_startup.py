"""What the benchmark of waiting makes of the output of a terminal, and what it runs."""

from pathlib import Path

import pytest

from benchmarks.startup import HERE, Output, cases, longest_silence


@pytest.mark.parametrize(
    ("wall_s", "cpu_s", "k"),
    [
        ([0.0, 1.0, 4.5, 5.0], [0.0, 1.0, 4.5, 5.0], 1),
        ([0.0, 9.0, 10.0, 12.0], [0.0, 0.1, 1.1, 3.1], 2),  # the first was spent waiting
        ([0.0, 1.0, 3.0], [0.0, 8.0, 9.5], 1),  # several processes at once
    ],
)
def test_the_longest_silence_is_between_two_outputs_without_waiting_for_a_processor(
    wall_s: list[float], cpu_s: list[float], k: int
) -> None:
    outputs = [Output(wall, cpu) for wall, cpu in zip(wall_s, cpu_s, strict=True)]
    assert longest_silence(outputs) == (outputs[k], outputs[k + 1])


def test_every_experiment_is_watched() -> None:
    paths = dict.fromkeys(["folder", "line", "grid", "signal"], Path("data"))
    commands = [case.command for case in cases(paths).values() if case.watched]
    seen = {text for command in commands for text in command if text.startswith("+exp=")}
    assert seen == {f"+exp={path.stem}" for path in HERE.glob("conf/exp/*.yaml")}
