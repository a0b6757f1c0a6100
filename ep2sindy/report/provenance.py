"""Which code made a run."""

from __future__ import annotations

import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

VERSIONED = (
    "ep2sindy", "numpy", "scipy", "numba", "scikit-learn", "xarray", "torch", "hydra-core",
    "pysindy",
)  # fmt: skip


def commit(folder: Path) -> str:
    """Git commit of a checkout's folder, with "+changes" if some are not committed."""
    if not (folder / ".git").exists():
        return "unknown: not a git checkout"  # git would take that of a folder around it
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
