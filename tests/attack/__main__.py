"""Attack the package: `make attack`, or `python -m tests.attack --files 5000 --kills 200`.

Seeded; what is done is kept in a folder, and the same line goes on from there.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from tests.attack import crafted, files, runs
from tests.attack.results import attacked, table

GOOD = {"same values", "other values", "refused", "whole", "ended before", "refused with path",
        "fewer writes", "went on", "harmless"}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--files", type=int, default=900, help="mutated files")
    parser.add_argument("--kills", type=int, default=8, help="runs ended at random moments")
    parser.add_argument("--writes", type=int, default=12, help="writes made to fail, in turn")
    parser.add_argument("--crafted", type=int, default=300, help="crafted configs and models")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", type=Path, default=Path(".cache/attack"))
    asked = parser.parse_args()
    folder = asked.folder.absolute() / f"seed{asked.seed}"
    places = [folder / name for name in ("files", "kills", "writes", "crafted")]
    for place in places:
        place.mkdir(parents=True, exist_ok=True)
    found = {}
    for title, cases, attack in (
        ("mutated files", files.cases(asked.files), files.attack(places[0], asked.seed)),
        ("killed runs", map(str, range(asked.kills)), runs.kill(places[1], asked.seed)),
        ("failing writes", map(str, range(1, asked.writes + 1)), runs.fail(places[2])),
        ("crafted files", crafted.cases(asked.crafted), crafted.attack(places[3])),
    ):
        found[title] = attacked(folder / f"{title.replace(' ', '_')}.jsonl", cases, attack)
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


if __name__ == "__main__":
    main()
