"""Charts of time against error: a panel for each case, both axes logarithmic."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from trainer.bench.rows import Row
from trainer.reporting.svg import (
    BAND_EDGE,
    BLUE,
    GREY,
    INK,
    LINE,
    PAPER,
    VERMILLION,
    drawing,
    element,
    line,
    polyline,
    text,
)

WIDTH, HEIGHT = 460.0, 390.0  # of one panel
LEFT, RIGHT, TOP, BOTTOM = 62.0, 22.0, 74.0, 46.0
#: One for each method of a case, in turn: Okabe and Ito's, which are told apart with any colour vision.
COLOURS = (VERMILLION, BLUE, BAND_EDGE, "#cc79a7", "#e69f00", "#56b4e9", INK, GREY)
#: Rows of no method, but of what methods are held against.
LIMIT = "memory limit"
#: One for each size of a case, smallest first.
DASHES = ("1 4", "4 3", "9 3", "none")


def chart(rows: Mapping[str, Sequence[Row]], counts: Mapping[str, str]) -> str:
    """An SVG of all cases; ``counts``: what the sizes of a subject's rows count."""
    panels: list[list[str]] = []
    drawn = {
        name: [r for r in of if r.frames and math.isfinite(r.error) and not r.method.startswith(LIMIT)]
        for name, of in rows.items()
    }
    for name, of_subject in drawn.items():
        for case in dict.fromkeys(r.case for r in of_subject):
            x0, y0 = len(panels) % 2 * WIDTH, len(panels) // 2 * HEIGHT
            panels.append(
                _panel(
                    x0,
                    y0,
                    case if case.startswith(name) else f"{name}: {case}",
                    counts[name],
                    [r for r in of_subject if r.case == case],
                )
            )
    width, height = 2.0 * WIDTH, max(math.ceil(len(panels) / 2), 1) * HEIGHT
    return drawing(
        width,
        height,
        element("rect", x=0.0, y=0.0, width=width, height=height, fill=PAPER),
        element("g", *(p for panel in panels for p in panel), font_family="sans-serif", font_size=11.0, fill=INK),
        label="Error over time for each case, method and size",
    )


def _decades(values: Sequence[float]) -> tuple[int, int]:
    """The decades that hold all ``values`` above zero; and one below them where there are others."""
    above = [v for v in values if v > 0.0] or [1.0]
    low = math.floor(math.log10(min(above))) - (len(above) < len(values))
    return low, max(math.ceil(math.log10(max(above))), low + 1)


def _panel(x0: float, y0: float, title: str, counts: str, rows: list[Row]) -> list[str]:
    left, right, top, bottom = x0 + LEFT, x0 + WIDTH - RIGHT, y0 + TOP, y0 + HEIGHT - BOTTOM
    across, up = _decades([r.median_ms for r in rows]), _decades([r.error for r in rows])

    exact = any(r.error == 0.0 for r in rows)

    def x(took: float) -> float:
        return left + (math.log10(took) - across[0]) / (across[1] - across[0]) * (right - left)

    def y(error: float) -> float:
        return bottom - (math.log10(error) - up[0]) / (up[1] - up[0]) * (bottom - top) if error > 0.0 else bottom

    parts = [text(left, y0 + 18.0, title, font_weight="bold")]
    for k in range(across[0], across[1] + 1):
        parts.append(line(x(10.0**k), top, x(10.0**k), bottom, stroke=LINE))
        parts.append(text(x(10.0**k), bottom + 15.0, f"{10.0**k:g}", text_anchor="middle"))
    for k in range(up[0], up[1] + 1, max(1, (up[1] - up[0]) // 8)):
        parts.append(line(left, y(10.0**k), right, y(10.0**k), stroke=LINE))
        label = "0" if k == up[0] and exact else f"{10.0**k:g}"
        parts.append(text(left - 6.0, y(10.0**k) + 4.0, label, text_anchor="end"))
    parts.append(text(left - 6.0, top - 8.0, "error", fill=GREY, text_anchor="end"))
    sizes = sorted({r.size for r in rows})
    dash = {size: DASHES[max(len(DASHES) - len(sizes), 0) + k] for k, size in enumerate(sizes[: len(DASHES)])}
    words = f"ms; {counts}: " + ", ".join(f"{size} {_in_words(dash.get(size, 'none'))}" for size in sizes)
    parts.append(text(0.5 * (left + right), bottom + 34.0, words, text_anchor="middle", fill=GREY))
    at = left
    for k, method in enumerate(dict.fromkeys(r.method for r in rows)):
        colour = COLOURS[k % len(COLOURS)]
        parts.append(text(at, y0 + 36.0 + 15.0 * (k % 2), method, fill=colour))
        at += (WIDTH - LEFT - RIGHT) / 3.0 if k % 2 else 0.0
        for rank, size in enumerate(sizes):
            radius = 2.0 + rank  # a method with one setting has no line to tell its size
            points = [(x(r.median_ms), y(r.error)) for r in rows if (r.method, r.size) == (method, size)]
            dashes = dash.get(size, "none")
            parts.append(polyline(points, stroke=colour, stroke_width=2.0, stroke_dasharray=dashes))
            parts += [element("circle", cx=px, cy=py, r=radius, fill=colour) for px, py in points]
    return parts


def _in_words(dashes: str) -> str:
    return {"1 4": "dotted", "4 3": "dashed", "9 3": "long dashes"}.get(dashes, "solid")
