"""What the benchmark of waiting makes of the output of a terminal, and what it runs."""

from pathlib import Path

import pytest

from benchmarks.startup import HERE, PROGRAM, Output, cases, longest_silence, watched


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


def test_a_bar_that_is_only_wiped_away_has_no_words() -> None:
    assert Output(0.0, 0.0, "\r       \r\x1b[A").words == []
    assert Output(0.0, 0.0, "\r 0/2 point\r\x1b[1m 1/2 point\x1b[0m\r\n").words == [
        "0/2 point", "1/2 point",
    ]  # fmt: skip


def test_every_experiment_is_watched() -> None:
    paths = dict.fromkeys(["folder", "line", "grid", "signal"], Path("data"))
    commands = [case.command for case in cases(paths).values() if case.watched]
    seen = {text for command in commands for text in command if text.startswith("+exp=")}
    assert seen == {f"+exp={path.stem}" for path in HERE.glob("conf/exp/*.yaml")}


def test_a_command_is_watched_on_a_terminal(tmp_path: Path) -> None:
    begin, *said, end = watched([*PROGRAM[:1], "-c", SAYS], tmp_path, {})
    assert (begin.text, end.text) == ("", "")
    assert [line for each in said for line in each.words] == ["True", "again"]


SAYS = "import sys; print(sys.stderr.isatty()); print('again', file=sys.stderr)"
