"""Run what README and docs show, and write into the pages what comes: their numbers, anew.

    python -m tests.rerun README.md docs/odes.md   # without names: all pages that show output

The tests run pages in the same way, and compare.
"""

import json
import os
import subprocess
import sys
from argparse import ArgumentParser
from collections.abc import Iterator
from contextlib import chdir, redirect_stdout
from dataclasses import dataclass
from functools import cache
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks.regions import three_regions
from ep2sindy.data.open import write_field
from tests.pages import (
    COMMAND,
    PAGES,
    QUOTED,
    ROOT,
    RUN_FOLDER,
    Block,
    arguments,
    blocks_of,
    commands,
    quoted,
    updated,
)

# Pages whose commands are run, one after the other, in one empty folder.
RUN_WHOLE = ("tutorial.md", "odes.md")


@dataclass(frozen=True)
class Ran:
    """What a command of a page printed, and the summary of its run."""

    printed: str
    summary: dict[str, Any]


def ran_blocks(page: Path, text: str, folder: Path) -> Iterator[tuple[Block, str]]:
    """The blocks of a page in their order, and what each prints; empty for those that do not run.

    folder: empty. It is given the files which pages open, run.h5 and grid.nc.
    """
    if page.name not in RUN_WHOLE:
        write_field(three_regions(n_z=6, n_r=5, n_samples=300).field, folder / "grid.nc")
        write_h5(folder / "run.h5")
    known: dict = {}
    with chdir(folder):
        for block in blocks_of(text):
            printed = StringIO()
            if block.language == "python":
                with redirect_stdout(printed):
                    exec(compile(block.text, page.name, "exec"), known)
            elif block.language == "bash" and page.name in RUN_WHOLE:
                for words in commands(block):
                    printed.write(run(words, folder))
            elif block.language == "console":
                printed.write(console(block.text).printed)
            yield block, printed.getvalue()


@cache
def console(command: str) -> Ran:
    """A command that pages show: run once, in a folder of its own."""
    (words,) = commands(Block("console", command))
    with TemporaryDirectory() as folder:
        printed = run(words, Path(folder))
        (summary,) = Path(folder).glob("outputs/*/*/summary.json")
        return Ran(RUN_FOLDER.sub(r"\1/...", printed), json.loads(summary.read_text("utf-8")))


def summary_of(text: str) -> dict[str, Any]:
    """The summary that the numbers in a page's text are from: of its first command.

    Raises ValueError for a page without a command.
    """
    command = COMMAND.search(text)
    if command is None:
        raise ValueError(
            "numbers of a summary need their command on the page: <!-- ep2sindy ... -->"
        )
    return console(command[1]).summary


def run(words: list[str], folder: Path) -> str:
    """What a command of the program prints."""
    given = arguments(words)
    assert given is not None, words
    command = [sys.executable, "-m", "ep2sindy.app.main", *given]
    here = {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    result = subprocess.run(
        command, cwd=folder, env=os.environ | here, capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr
    return result.stdout


def write_h5(path: Path) -> None:
    """What docs/data.md opens: names and units of its own."""
    import h5py

    with h5py.File(path, "w") as file:
        file["t"], file["z"] = np.linspace(0.0, 400.0, 201), np.linspace(1.0, 3.0, 11)
        wave = 1.0 + 0.5 * np.sin(np.linspace(0.0, 40.0, 201))[:, None] * np.ones(11)
        for name in ("ni", "nn", "rate", "uz"):
            file[name] = 1e12 * wave


def rewritten(page: Path) -> str:
    """The text of a page with what its blocks print now, and with the numbers of its summary.

    Raises ValueError if something came that is not like what the page shows.
    """
    text = page.read_text("utf-8")
    changes = []
    with TemporaryDirectory() as folder:
        for block, came in ran_blocks(page, text, Path(folder)):
            if block.printed is not None:
                changes.append((block.place, updated(block.printed, came)))
    for (start, stop), new in reversed(changes):
        text = text[:start] + new + text[stop:]
    if not QUOTED.search(text):
        return text
    summary = summary_of(text)
    return QUOTED.sub(lambda m: m[0].replace(m[1], quoted(m[1], summary, m[2], m[3]), 1), text)


def main() -> None:
    parser = ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("page", nargs="*", type=Path, help="such as README.md")
    for page in parser.parse_args().page or PAGES:
        text = page.read_text("utf-8")
        if all(block.printed is None for block in blocks_of(text)) and not QUOTED.search(text):
            continue
        new = rewritten(page)
        changed = new != text
        page.write_text(new, "utf-8")
        name = page.relative_to(ROOT) if page.is_absolute() else page
        print(name, "changed" if changed else "as before", flush=True)


if __name__ == "__main__":
    main()
