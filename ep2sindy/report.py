"""A run's folder: everything a figure needs to be redrawn, and one page to read.

config.yaml  provenance.json  run.log  summary.json  report.html
models/*.json  tables/*.csv  figures/*.png, *.pdf  tensorboard/
"""

from __future__ import annotations

import html
import json
import math
import platform
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.figure import Figure
from rich.console import Console, RenderableType

from ep2sindy.files import replacing, write_text
from ep2sindy.model import SparseModel
from ep2sindy.names import split_factors

WIDTH = 120  # columns of run.log, and of output that goes to a file
VERSIONED = (
    "ep2sindy", "numpy", "scipy", "numba", "scikit-learn", "xarray", "torch", "hydra-core",
    "pysindy",
)  # fmt: skip


@dataclass(frozen=True)
class RunFolder:
    """Writes a run's results, each file whole or not at all."""

    path: Path

    @staticmethod
    def create(root: Path, experiment: str, *, now: datetime) -> RunFolder:
        """Make `root/experiment/<date>_<time>`, with a suffix if another run took that name.

        Raises OSError, with the way out, where no folder can be written.
        """
        parent = root / experiment
        try:
            parent.mkdir(parents=True, exist_ok=True)
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

    def write_text(self, name: str, text: str) -> None:
        write_text(self.path / name, text)

    def write_json(self, name: str, content: Mapping[str, Any]) -> None:
        """NaN becomes null: JSON has no word for it."""
        text = json.dumps(_without_nan(content), indent=2, allow_nan=False)
        self.write_text(name, text + "\n")

    def write_model(self, name: str, model: SparseModel) -> None:
        model.save(self.path / "models" / f"{name}.json")

    def write_table(self, name: str, table: pd.DataFrame) -> None:
        self.write_text(f"tables/{name}.csv", table.to_csv(index=False))

    def write_figures(self, figures: Mapping[str, Figure]) -> None:
        for name, figure in figures.items():
            for suffix in ("png", "pdf"):
                # Without a date the same run gives the same file.
                dated = {"CreationDate": None} if suffix == "pdf" else {}
                with replacing(self.path / "figures" / f"{name}.{suffix}") as temporary:
                    figure.savefig(temporary, dpi=150, metadata=dated)

    def write_provenance(self, *, seed: int, command: Sequence[str]) -> None:
        self.write_json(
            "provenance.json",
            {
                "commit": commit(Path(__file__).parent),
                "seed": seed,
                "command": list(command),
                "versions": {"python": platform.python_version(), **versions()},
            },
        )


class Screen:
    """Prints to the terminal and, without colours, to run.log."""

    def __init__(self, log: Path) -> None:
        self._log = log.open("a", encoding="utf-8")
        terminal = Console()
        if not terminal.is_terminal:
            terminal.width = WIDTH
        self._consoles = (terminal, Console(file=self._log, width=WIDTH, no_color=True))

    def print(self, *renderables: RenderableType) -> None:
        for console in self._consoles:
            console.print(*renderables, highlight=False)
        self._log.flush()

    def log(self, text: str) -> None:
        """Into run.log alone."""
        self._consoles[1].print(text, highlight=False, markup=False)

    def close(self) -> None:
        self._log.close()


class LiveScalars:
    """Scalars that TensorBoard shows while the run goes on; use it as a context."""

    def __init__(self, folder: Path) -> None:
        from torch.utils.tensorboard import SummaryWriter  # PyTorch takes seconds to import

        self._writer = SummaryWriter(folder)

    def write(self, scalars: Mapping[str, float], *, step: int) -> None:
        for name, value in scalars.items():
            self._writer.add_scalar(name, value, step)
        self._writer.flush()

    def __enter__(self) -> LiveScalars:
        return self

    def __exit__(self, *exception: object) -> None:
        self._writer.close()


def commit(folder: Path) -> str:
    """Git commit of the code in `folder`, with "+changes" if some are not committed."""
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


def write_tensorboard(
    folder: Path,
    *,
    figures: Mapping[str, Figure],
    texts: Mapping[str, str],
    hparams: Mapping[str, Any],
    metrics: Mapping[str, float],
) -> None:
    """Figures, equations, and the metrics of one run beside the settings that led to them.

    Runs are compared by the keys of hparams and metrics: keep them fixed.
    """
    from torch.utils.tensorboard import SummaryWriter  # PyTorch takes seconds to import

    with SummaryWriter(folder) as writer:
        for name, figure in figures.items():
            writer.add_figure(name, figure)
        for name, text in texts.items():
            writer.add_text(name, text)
        writer.add_hparams(dict(hparams), dict(metrics), run_name=".")


def equation_html(state: str, terms: Mapping[str, float], *, digits: int = 3) -> str:
    """One equation with sub- and superscripts: n<sub>i</sub>' = -2.62e5 ... in HTML."""
    parts = []
    for k, (name, coef) in enumerate(terms.items()):
        sign = "&minus;" if coef < 0 else "+" if k else ""
        mantissa, _, exponent = f"{abs(coef):.{digits}g}".partition("e")
        number = mantissa + (f"&times;10<sup>{int(exponent)}</sup>" if exponent else "")
        factors = [] if name == "1" else [_factor_html(v, p) for v, p in split_factors(name)]
        parts.append(" ".join([sign, number, *factors]).strip())
    left = f"d{_factor_html(state, 1)}/dt"
    return f"{left} = {' '.join(parts) or '0'}".replace("-", "&minus;")


def _factor_html(variable: str, power: int) -> str:
    if variable.startswith("<"):
        inner = " ".join(_factor_html(v, p) for v, p in split_factors(variable[1:-1]))
        text = f"&lang;{inner}&rang;"
    else:
        stem, _, index = variable.partition("_")
        text = f"<i>{html.escape(stem)}</i>" + (f"<sub>{html.escape(index)}</sub>" if index else "")
    return text + (f"<sup>{power}</sup>" if power > 1 else "")


def table_html(table: pd.DataFrame, *, bold: Sequence[bool] = ()) -> str:
    """A table with numbers to three digits; cells may hold HTML of our own."""
    head = "".join(f"<th>{html.escape(str(c))}</th>" for c in table.columns)
    rows = []
    for k, row in enumerate(table.itertuples(index=False)):
        cells = "".join(f"<td>{_cell(value)}</td>" for value in row)
        style = ' class="selected"' if k < len(bold) and bold[k] else ""
        rows.append(f"<tr{style}>{cells}</tr>")
    return f"<table><tr>{head}</tr>{''.join(rows)}</table>"


def _cell(value: object) -> str:
    if isinstance(value, float):
        return "&ndash;" if math.isnan(value) else f"{value:.3g}"
    return str(value)


def page_html(title: str, body: Sequence[str]) -> str:
    """A page that needs no network: figures lie beside it in figures/."""
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f"<style>{_STYLE}</style><body><h1>{html.escape(title)}</h1>{''.join(body)}</body></html>\n"
    )


def figure_html(name: str, caption: str) -> str:
    return (
        f'<figure><img src="figures/{name}.png" alt="{html.escape(caption)}">'
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
    )


_STYLE = """
body { font: 16px/1.5 Georgia, serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem; }
h1, h2, h3 { font-family: Helvetica, Arial, sans-serif; line-height: 1.2; }
table { border-collapse: collapse; margin: 1rem 0; font-size: 0.92rem; }
th, td { padding: 0.2rem 0.8rem; text-align: left; border-bottom: 1px solid #ddd; }
tr.selected { font-weight: bold; background: #fdf3e1; }
figure { margin: 1.5rem 0; } img { max-width: 100%; }
figcaption, footer { color: #555; font-size: 0.9rem; }
.published { margin: 0.1rem 1.5rem; color: #555; }
.equation { font-size: 1.15rem; margin: 0.4rem 1.5rem; }
"""


def _without_nan(content: Any) -> Any:
    if isinstance(content, Mapping):
        return {key: _without_nan(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_without_nan(value) for value in content]
    if isinstance(content, float) and not math.isfinite(content):
        return None
    return content
