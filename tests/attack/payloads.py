"""What crafted files are made of: a case, a mark that a payload leaves, and text that would run."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

CANARY = "canary_that_sang"
RUNS = f"__import__('pathlib').Path('{CANARY}').touch()"
BOMB = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]\n" for k in range(1, 12)
)
TABLE = "t,x,y\n" + "".join(f"{k},{k % 7 + 1},{k % 5 + 2}\n" for k in range(60))


@dataclass(frozen=True)
class Case:
    """Files below the folder that a run starts in, and its command line.

    names: what a refusal must name, a key or a file. may_pass: it may also be read as data.
    make: lays down what is no text.
    """

    arguments: Sequence[str]
    files: Mapping[str, str] = field(default_factory=dict)
    names: str = ""
    may_pass: bool = False
    make: Callable[[Path], object] | None = None

    def lay_down(self, here: Path) -> None:
        for name, text in {"a.csv": TABLE, **self.files}.items():
            path = here / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, "utf-8")
        if self.make:
            self.make(here)


class Sings:
    """Unpickled, it leaves a mark."""

    def __reduce__(self) -> tuple[object, ...]:
        return eval, (RUNS,)
