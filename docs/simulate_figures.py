"""Draw the figures of docs/thruster.md by the commands that it names.

python docs/simulate_figures.py     # some minutes; prints what docs/thruster.md quotes
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

DOCS = Path(__file__).resolve().parent
ONE = ["+exp=simulate", "data.progress=false"]
FIGURES = {"maps": ONE, "profiles": ONE}


def main(overrides: list[str]) -> None:
    folders: dict[str, Path] = {}
    for name, command in FIGURES.items():
        key = " ".join(command)
        if key not in folders:
            program = [sys.executable, "-m", "experiments.run", *command, *overrides]
            done = subprocess.run(program, cwd=DOCS.parent, stdout=subprocess.PIPE, text=True)
            print(done.stdout)
            done.check_returncode()
            folders[key] = DOCS.parent / Path(done.stdout.split()[-1]).parent  # of the page
        drawn = folders[key] / "figures" / f"{name}.png"
        shutil.copyfile(drawn, DOCS / f"simulate_{name}.png")


if __name__ == "__main__":
    main(sys.argv[1:])
