"""The folder of a run: everything needed to redraw its figures, and one page to read.

config.yaml  provenance.json  run.log  summary.json  report.html
models/*.json  tables/*.csv  figures/*.png  tensorboard/
"""

from __future__ import annotations

import platform
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from importlib.metadata import PackageNotFoundError, version
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ep2sindy.report.page import DPI
from ep2sindy.runtime.files import sweep, write_bytes, write_json

if TYPE_CHECKING:
    from matplotlib.figure import Figure

VERSIONED = (
    "ep2sindy", "numpy", "scipy", "numba", "scikit-learn", "xarray", "torch", "hydra-core",
    "pysindy",
)  # fmt: skip
# Formats of a figure, with metadata: without a date the file is the same each time.
FORMATS: Mapping[str, dict[str, Any]] = {"png": {}, "pdf": {"CreationDate": None}}


@dataclass(frozen=True)
class RunFolder:
    """Writes the results of a run; each file is complete or absent."""

    path: Path

    @staticmethod
    def create(root: Path, experiment: str, *, now: datetime) -> RunFolder:
        """Make `root/experiment/<date>_<time>`, with a suffix if another run took that name.

        Raises OSError, with a hint, if no folder can be written.
        """
        parent = root / experiment
        try:
            parent.mkdir(parents=True, exist_ok=True)
            sweep(parent)
            stamp = f"{now:%Y-%m-%d_%H%M%S}"
            for name in [stamp, *(f"{stamp}_{k}" for k in range(2, 1000))]:
                try:
                    (parent / name).mkdir()
                except FileExistsError:
                    continue
                return RunFolder(parent / name)
        except OSError as error:
            raise OSError(
                f"a run needs a folder it can write to: {parent} failed with {error.strerror!r}; "
                "choose another with output=PATH"
            ) from error
        raise OSError(f"1000 runs started in one second in {parent}; wait and start again")

    def file(self, name: str, folder: str = "") -> Path:
        """Path of a result. Raises ValueError for a name that is a path."""
        if name != Path(name).name or "\\" in name or not name.isprintable():
            raise ValueError(f"a result's name must be that of a file, and no path, got {name!r}")
        return self.path / folder / name

    def write_figure(self, name: str, figure: Figure, formats: Sequence[str] = ("png",)) -> bytes:
        """Write a figure in several formats with the same layout; returns the content of the PNG.

        The figure keeps this layout. formats: some of FORMATS, png among them.
        """
        freeze_layout(figure)
        contents = {}
        for suffix in formats:
            drawn = BytesIO()  # in memory: on a full disk a PDF fails again, in zlib, on closing
            figure.savefig(drawn, format=suffix, dpi=DPI, metadata=FORMATS[suffix])
            contents[suffix] = drawn.getvalue()
            write_bytes(self.file(f"{name}.{suffix}", "figures"), contents[suffix])
        return contents["png"]

    def write_provenance(self, *, seed: int, command: Sequence[str]) -> dict[str, Any]:
        """Write commit, seed, command and versions to provenance.json, and return them."""
        found = {
            "commit": commit(Path(__file__).resolve().parents[2]),
            "seed": seed,
            "command": list(command),
            "versions": {"python": platform.python_version(), **versions()},
        }
        write_json(self.file("provenance.json"), found)
        return found


def freeze_layout(figure: Figure) -> None:
    """Solve the layout once: otherwise every saving would solve it again, and draw twice."""
    engine: Any = figure.get_layout_engine()
    if engine is not None:
        engine.set(w_pad=0.12, h_pad=0.08)  # inches: after one pass labels may be that far off
        figure.set_dpi(DPI)
        engine.execute(figure)
        figure.set_layout_engine(None)  # not "none": that placeholder still draws twice


def commit(folder: Path) -> str:
    """Git commit of a checkout's folder, with "+changes" if there are uncommitted ones."""
    if not (folder / ".git").exists():
        return "unknown: not a git checkout"  # git would report the commit of an enclosing checkout
    try:
        head = _git(folder, "rev-parse", "HEAD")
        return head + ("+changes" if _git(folder, "status", "--porcelain") else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown: not a git checkout"


def _git(folder: Path, *arguments: str) -> str:
    result = subprocess.run(
        ["git", *arguments], cwd=folder, capture_output=True, text=True, check=True
    )
    return result.stdout.strip()


def versions() -> dict[str, str]:
    found = {}
    for name in VERSIONED:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found
