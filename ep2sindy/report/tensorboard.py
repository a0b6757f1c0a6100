"""What TensorBoard shows of a run."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure


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
