"""Figures inside a page: embedded PNG images."""

from __future__ import annotations

from base64 import b64encode
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

from ep2sindy.runtime.files import read_bytes

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PX_PER_INCH = 96  # of a page: letters have the same size in all figures
DPI = 150  # of figures in a run folder

LARGE = 100_000  # bytes of a PNG from which a page holds it in 256 colours, a third of its size


@dataclass(frozen=True)
class Drawn:
    """A figure as HTML.

    html: an element that needs no other file. width_px: intended width.
    """

    html: str
    caption: str
    width_px: int


def draw(figure: Figure, png: bytes, caption: str) -> Drawn:
    """A figure for a page, by its PNG."""
    width = round(figure.get_size_inches()[0] * PX_PER_INCH)
    return Drawn(png_html(in_few_colours(png) if len(png) > LARGE else png), caption, width)


def in_few_colours(png: bytes) -> bytes:
    """The image in its 256 most distinct colours, of which others differ by a few percent."""
    from PIL import Image  # comes with matplotlib

    buffer = BytesIO()
    image = Image.open(BytesIO(png)).convert("RGB")
    image.quantize(256, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(
        buffer, "PNG"
    )
    return buffer.getvalue()


def read_png(path: Path, caption: str) -> Drawn:
    """A figure written by an earlier run. Raises ValueError for a file that is no PNG."""
    png = read_bytes(path)
    if not png.startswith(b"\x89PNG\r\n"):
        raise ValueError(f"{path} must be a PNG, got {png[:8]!r}; take it out of the run's figures")
    width = int.from_bytes(png[16:20], "big")  # width in the PNG header
    return Drawn(png_html(png), caption, round(width / DPI * PX_PER_INCH))


def png_html(png: bytes) -> str:
    return f'<img alt="" src="data:image/png;base64,{b64encode(png).decode()}">'
