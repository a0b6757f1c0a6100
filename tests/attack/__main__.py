"""Attack the package: `make attack`, or `python -m tests.attack --files 5000 --kills 200`.

Seeded; what is done is kept in a folder, and the same line goes on from there.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable
from pathlib import Path

from tests.attack import crafted, files, kills, soak, writes
from tests.attack.results import Outcome, attacked, table
from tests.attack.runs import RUNS

GOOD = {
    "same values", "other values", "refused", "harmless",  # files, crafted ones too
    "same bytes",  # killed runs, two threads, one core
    "refused with path", "recovered", "fewer writes",  # failing writes
    "both ended", "one refused",  # two runs at once
    "no growth",  # soaks
}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--files", type=int, default=900, help="mutated files")
    parser.add_argument("--kills", type=int, default=7, help="runs ended at random moments")
    parser.add_argument("--writes", type=int, default=14, help="writes made to fail, of some 750")
    parser.add_argument("--pairs", type=int, default=3, help="two runs at once in one folder")
    parser.add_argument(
        "--machines", type=int, default=2, help="runs on two threads, and on one core, of 7"
    )
    parser.add_argument("--soak", type=int, default=5, help="rounds of short runs in one process")
    parser.add_argument("--crafted", type=int, default=40, help="crafted files, of some 260")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--part", type=part, default="1/1", help="K/N: the K-th of N parts")
    parser.add_argument("--folder", type=Path, default=Path(".cache/attack"))
    asked = parser.parse_args()
    folder = asked.folder.absolute() / f"seed{asked.seed}"
    for name in ("files", "runs", "crafted"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    found = {}
    for title, cases, attack in attacks(asked, folder):
        mine = list(cases)[asked.part]
        found[title] = attacked(folder / f"{title.replace(' ', '_')}.jsonl", mine, attack)
    print("| attack | what became of it | cases |\n|---|---|---|")
    print("\n".join(row for title, done in found.items() for row in table(title, done)))
    wrong = [
        f"{title} {case}: {kind}: {words[:200]}"
        for title, done in found.items()
        for case, (kind, words) in done.items()
        if kind not in GOOD
    ]
    if wrong:
        raise SystemExit("\n".join(wrong))


def part(text: str) -> slice:
    """Of cases that are attacked in several folders side by side, which are for this one."""
    k, n = map(int, text.split("/"))
    if not 1 <= k <= n:
        raise ValueError
    return slice(k - 1, None, n)


def attacks(
    asked: argparse.Namespace, folder: Path
) -> list[tuple[str, Iterable[str], Callable[[str], Outcome]]]:
    """Each with its cases, as many as were asked for."""
    runs, seed = folder / "runs", asked.seed
    failing = writes.drawn(runs, asked.writes, seed) if asked.writes else []
    rounds = [f"{name}-{asked.soak}" for name in soak.KINDS] if asked.soak else []
    return [
        ("mutated files", files.cases(asked.files), files.attack(folder / "files", seed)),
        ("killed runs", kills.in_turn(asked.kills), kills.killed(runs, seed)),
        ("failing writes", failing, writes.failing(runs)),
        ("two runs at once", kills.in_turn(asked.pairs), kills.paired(runs, seed)),
        ("two threads", list(RUNS)[: asked.machines], kills.elsewhere(runs, threads=2)),
        ("one core", list(RUNS)[: asked.machines], kills.elsewhere(runs, cores=1)),
        ("crafted files", crafted.cases(asked.crafted), crafted.attack(folder / "crafted")),
        ("soaks", rounds, soak.soaked(runs)),
    ]


if __name__ == "__main__":
    main()
