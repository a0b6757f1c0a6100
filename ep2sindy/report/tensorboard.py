"""Output of a run for TensorBoard, written directly as event files, without PyTorch."""

from __future__ import annotations

import os
import platform
import struct
import time
from collections.abc import Mapping
from pathlib import Path
from textwrap import indent
from typing import Any

from ep2sindy.runtime.files import writing


class Board:
    """One run in TensorBoard; opened at the first output, because the import takes a while.

    TensorBoard's own writer is not used: it works in a thread, which prints errors itself.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._writer: Any = None

    def scalars(self, scalars: Mapping[str, float], *, step: int) -> None:
        """Add points to curves that grow during the run."""
        values = [{"tag": tag, "simple_value": value} for tag, value in scalars.items()]
        self._add({"value": values}, step=step)

    def equations(self, texts: Mapping[str, str]) -> None:
        """The equations of all models, by name, as one block of lines in a fixed-width font."""
        if not texts:
            return
        from tensorboard.plugins.text.metadata import create_summary_metadata

        parts = (f"{name}\n{indent(text, '  ')}" for name, text in texts.items())
        lines = indent("\n\n".join(parts), "    ", lambda line: True)  # a block of code
        tensor = {"dtype": "DT_STRING", "string_val": [lines.encode()]}
        kind = create_summary_metadata(display_name="equations", description="")
        self._add({"value": [{"tag": "equations", "metadata": kind, "tensor": tensor}]})

    def image(self, name: str, png: bytes) -> None:
        """A figure, as the PNG drawn for the folder."""
        width, height = struct.unpack(">II", png[16:24])  # in the PNG header
        size = {"height": height, "width": width, "colorspace": 4}
        self._add({"value": [{"tag": name, "image": size | {"encoded_image_string": png}}]})

    def settings(self, hparams: Mapping[str, Any], metrics: Mapping[str, float]) -> None:
        """The metrics with the settings that led to them; TensorBoard compares runs by their keys.

        No list of keys is written, because TensorBoard would use the first run's for all runs.
        """
        from tensorboard.plugins.hparams import summary_v2 as hp

        self._add(hp.hparams_pb(dict(hparams), trial_id=self._folder.parent.name))
        self.scalars(metrics, step=0)

    def close(self) -> None:
        writer, self._writer = self._writer, None
        if writer is not None:
            with writing(self._folder):
                writer.close()

    def _add(self, summary: Any, *, step: int = 0) -> None:
        """Add a summary, or the fields of one."""
        with writing(self._folder):
            if self._writer is None:
                self._writer = _open(self._folder)
                self._writer.write(_event(file_version="brain.Event:2"))
            self._writer.write(_event(step=step, summary=summary))
            self._writer.flush()


def _open(folder: Path) -> Any:
    """An event file, named so that TensorBoard finds it."""
    from tensorboard.summary.writer.record_writer import RecordWriter

    folder.mkdir(parents=True, exist_ok=True)
    name = f"events.out.tfevents.{int(time.time()):010d}.{platform.node()}.{os.getpid()}.0"
    return RecordWriter((folder / name).open("wb"))


def _event(**content: Any) -> bytes:
    from tensorboard.compat.proto.event_pb2 import Event

    return Event(wall_time=time.time(), **content).SerializeToString()
