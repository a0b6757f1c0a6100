"""Figures inside a page: as images in the text itself, or as drawings that say more on hover."""

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
PX_PER_INCH = 96  # of a page: one size of letters in all figures, whatever their own
DPI = 150  # of figures in a run folder
HOVER = "hover: "  # begins the id of an artist that says more, see `figures.style.hover`


@dataclass(frozen=True)
class Drawn:
    """A figure that has been drawn.

    html: an element that needs no other file. width_px: how wide it is meant to be.
    """

    html: str
    caption: str
    width_px: int


def draw(figure: Figure, png: bytes, caption: str) -> Drawn:
    """A figure for a page: its PNG, or where something in it says more on hover, its SVG."""
    width = round(figure.get_size_inches()[0] * PX_PER_INCH)
    speaks = figure.findobj(lambda artist: (artist.get_gid() or "").startswith(HOVER))
    if speaks:
        return Drawn(svg_html(figure), f"{caption} Marks say more under a mouse.", width)
    return Drawn(png_html(png), caption, width)


def read_png(path: Path, caption: str) -> Drawn:
    """A figure that an earlier run wrote."""
    png = path.read_bytes()
    width = struct.unpack(">I", png[16:20])[0]  # of the header, which comes first
    return Drawn(png_html(png), caption, round(width / DPI * PX_PER_INCH))


def png_html(png: bytes) -> str:
    return f'<img alt="" src="data:image/png;base64,{b64encode(png).decode()}">'


def svg_html(figure: Figure) -> str:
    """An SVG in which artists that say more have a title, which browsers show on hover."""
    from matplotlib import rc_context

    buffer = BytesIO()
    with rc_context({"svg.hashsalt": "ep2sindy"}):  # the same figure, the same ids
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
        root.attrib.pop(size, None)  # the page sets them
    return ElementTree.tostring(root, encoding="unicode")
