"""SVG as text: an element is a name, attributes and children; everything written is escaped."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape

# Okabe and Ito's colours, told apart with any colour vision, and a few greys.
INK = "#1b2330"
GREY = "#66707f"
LINE = "#c9cfd8"
PAPER = "#ffffff"
BLUE = "#0072b2"
VERMILLION = "#d55e00"
BAND = "#d3ece3"
BAND_EDGE = "#009e73"


def element(name: str, *children: str, **attributes: str | float) -> str:
    """An element; ``stroke_width=1`` becomes ``stroke-width="1"``. Children are SVG already, attributes are not."""
    written = "".join(f' {k.rstrip("_").replace("_", "-")}="{_value(v)}"' for k, v in attributes.items())
    return f"<{name}{written}>{''.join(children)}</{name}>" if children else f"<{name}{written}/>"


def _value(v: str | float) -> str:
    return escape(v) if isinstance(v, str) else f"{v:.2f}".rstrip("0").rstrip(".")


def text(x: float, y: float, words: str, **attributes: str | float) -> str:
    """Words at a place; ``text_anchor="middle"`` centres them."""
    return element("text", escape(words), x=x, y=y, **attributes)


def line(x1: float, y1: float, x2: float, y2: float, **attributes: str | float) -> str:
    return element("line", x1=x1, y1=y1, x2=x2, y2=y2, **attributes)


def polyline(points: Sequence[tuple[float, float]], **attributes: str | float) -> str:
    return element("polyline", points=" ".join(f"{x:.2f},{y:.2f}" for x, y in points), fill="none", **attributes)


def drawing(width: float, height: float, *children: str, label: str) -> str:
    """A whole figure; ``label`` says what it shows to who cannot see it."""
    return element(
        "svg",
        element("title", escape(label)),
        *children,
        viewBox=f"0 0 {width:g} {height:g}",
        width=width,
        height=height,
        role="img",
        xmlns="http://www.w3.org/2000/svg",
    )


def ticks(low: float, high: float, about: int = 5) -> list[float]:
    """Round numbers (1, 2, 2.5 or 5 times a power of ten) that cover low to high in about so many steps."""
    span = high - low if high > low else 1.0
    rough = span / about
    power = 10.0 ** math.floor(math.log10(rough))
    step = power * next((m for m in (1.0, 2.0, 2.5, 5.0) if m * power >= rough * 0.999), 10.0)
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [step * k for k in range(first, max(last, first + 1) + 1)]


def mix(low: str, high: str, fraction: float) -> str:
    """The colour between two ``#rrggbb``."""
    pairs = zip(_rgb(low), _rgb(high), strict=True)
    return "#" + "".join(f"{round(a + (b - a) * fraction):02x}" for a, b in pairs)


def _rgb(colour: str) -> tuple[int, int, int]:
    return (int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16))


def is_dark(colour: str) -> bool:
    """Whether white words read better on it than black ones (relative luminance by ITU-R BT.709's weights)."""
    r, g, b = _rgb(colour)
    return 0.2126 * r + 0.7152 * g + 0.0722 * b < 140.0
