"""Figures inside a page: embedded PNG images, or SVG drawings with texts on hover."""

from __future__ import annotations

import re
import struct
from base64 import b64encode
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SVG = "http://www.w3.org/2000/svg"
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
    """A figure for a page: its PNG, or its SVG if artists in it have a text on hover."""
    from ep2sindy.figures.style import HOVER  # loads matplotlib, as a figure has

    width = round(figure.get_size_inches()[0] * PX_PER_INCH)
    speaks = figure.findobj(lambda artist: (artist.get_gid() or "").startswith(HOVER))
    if speaks:
        return Drawn(svg_html(figure), f"{caption} Marks say more under a mouse.", width)
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
    """A figure written by an earlier run."""
    png = path.read_bytes()
    width = struct.unpack(">I", png[16:20])[0]  # width in the PNG header
    return Drawn(png_html(png), caption, round(width / DPI * PX_PER_INCH))


def png_html(png: bytes) -> str:
    return f'<img alt="" src="data:image/png;base64,{b64encode(png).decode()}">'


def svg_html(figure: Figure) -> str:
    """An SVG in which the hover texts of artists are titles, which browsers show on hover."""
    from matplotlib import rc_context

    from ep2sindy.figures.style import HOVER

    buffer = BytesIO()
    with rc_context({"svg.hashsalt": "ep2sindy"}):  # the same figure gets the same ids
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    ElementTree.register_namespace("", SVG)
    ElementTree.register_namespace("xlink", "http://www.w3.org/1999/xlink")
    root = ElementTree.fromstring(buffer.getvalue())
    for element in root.iter(f"{{{SVG}}}g"):
        if (text := element.get("id", "")).startswith(HOVER):
            del element.attrib["id"]
            title = ElementTree.Element(f"{{{SVG}}}title")
            title.text = re.sub(r"\s*\|\s*", "\n", text.removeprefix(HOVER))
            element.insert(0, title)
    for metadata in root.findall(f"{{{SVG}}}metadata"):
        root.remove(metadata)
    for size in ("width", "height"):
        root.attrib.pop(size, None)  # the page sets the size
    return ElementTree.tostring(root, encoding="unicode")
