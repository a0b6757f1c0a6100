"""What an attack found, kept line by line, so that one that was broken off goes on."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path

from tqdm import tqdm

Outcome = tuple[str, str]  # what became of a case, and words on it


def attacked(
    file: Path, cases: Iterable[str], attack: Callable[[str], Outcome]
) -> dict[str, Outcome]:
    """Every case once: those that the file holds are not tried again."""
    file.parent.mkdir(parents=True, exist_ok=True)
    lines = file.read_text("utf-8").splitlines() if file.exists() else []
    done = {case: (kind, words) for case, kind, words in map(json.loads, lines)}
    with file.open("a", encoding="utf-8") as kept:
        waiting = [case for case in cases if case not in done]
        for case in tqdm(waiting, desc=file.stem, disable=not waiting):
            done[case] = attack(case)
            print(json.dumps([case, *done[case]]), file=kept, flush=True)
    return done


def table(title: str, done: dict[str, Outcome]) -> list[str]:
    """Rows of the table of docs/trust.md: what became of how many."""
    counts = Counter(kind for kind, _ in done.values())
    return [f"| {title} | {kind} | {n} of {len(done)} |" for kind, n in sorted(counts.items())]
