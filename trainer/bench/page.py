"""The report of ``trainer bench speed-error``: a page in Markdown, a chart, and the numbers."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from trainer.bench.machine import in_words
from trainer.bench.rows import Row
from trainer.bench.vessel import COLD_STARTS, FRAME_MM, FRAMES_OUT, REFERENCE_mN
from trainer.reporting.svg import BLUE, GREY, INK, LINE, PAPER, VERMILLION, drawing, element, line, polyline, text

#: The error at which the methods' times are compared, radii.
COMPARED_AT = 1e-2
WIDTH, HEIGHT = 400.0, 330.0  # of one panel
LEFT, RIGHT, TOP, BOTTOM = 62.0, 22.0, 34.0, 46.0


def document(rows: Sequence[Row], order: dict[int, float], about: dict[str, Any], quick: bool) -> dict[str, Any]:
    """What ``--json`` prints and ``speed_error.json`` holds."""
    return {
        "quick": quick,
        "machine": about,
        "relaxation_order_ms": {str(size): took for size, took in order.items()},
        "rows": [asdict(row) for row in rows],
    }


def write(folder: Path, rows: Sequence[Row], order: dict[int, float], about: dict[str, Any], quick: bool) -> list[Path]:
    """``speed_error`` .md, .svg and .json in ``folder``, which is made if need be. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    written = {
        folder / "speed_error.md": markdown(rows, order, about, quick),
        folder / "speed_error.svg": chart(rows) + "\n",
        folder / "speed_error.json": json.dumps(document(rows, order, about, quick), indent=1, allow_nan=False) + "\n",
    }
    for path, words in written.items():
        path.write_text(words, encoding="utf-8")
    return list(written)


def markdown(rows: Sequence[Row], order: dict[int, float], about: dict[str, Any], quick: bool) -> str:
    spent = ", ".join(f"{took:.1f} ms at {size} nodes" for size, took in order.items())
    lines = [
        "# Time against error: a vessel's equilibrium",
        "",
        f"Written by `trainer bench speed-error{' --quick' if quick else ''}`. {in_words(about)}.",
        "",
        "![Time against error](speed_error.svg)",
        "",
        "A vessel of 1 mm, clamped at both ends as in the paper, or with a free cut edge as in a task; one node of its",
        f"outer wall, half-way along, is drawn outwards. *Tracking*: {FRAME_MM} mm in each frame, {FRAMES_OUT} frames",
        f"out and {FRAMES_OUT} back; ms per frame. *Cold*: from rest to the",
        f"farthest place at once, {COLD_STARTS} times, with all that a method prepares (the factor, the order of the",
        "nodes). The methods take turns, frame by frame.",
        "",
        "*Error* is the solver's: the largest distance of a node to the converged answer of the same model (Newton's",
        f"method, residual below {REFERENCE_mN:g} mN, along the same path), in radii of the vessel. It says nothing",
        "about how well the model describes tissue. *Residual* is the norm of the forces on the free nodes, measured",
        "alike for both methods. Both are the worst of all frames. Times are medians, with the 90th percentile.",
        "",
        "*Relaxation* is the paper's (Brown et al. 2001, section 3), with a step from the local stiffness, stopped",
        "after a number of sweeps. *Kept factor* is what the program runs: L-BFGS over the factor of the rest state;",
        "it draws the node by a stiff spring, and in tracking the factor was made before the first frame.",
        f"The relaxation's order of nodes is not compiled; of each frame it takes {spent}.",
        "",
        f"The fastest setting tried whose error is at most {COMPARED_AT:g} R:",
        "",
        *comparison(rows),
        "",
        "| case | nodes | method | setting | median ms | p90 ms | error / R | residual mN | status |",
        "|---|--:|---|---|--:|--:|--:|--:|---|",
    ]
    for r in rows:
        lines.append(
            f"| {r.case} | {r.size} | {r.method} | {r.setting} | {ms(r.median_ms)} | {ms(r.p90_ms)} "
            f"| {r.error:.1e} | {r.residual:.1e} | {r.status} |"
        )
    return "\n".join([*lines, ""])


def ms(value: float) -> str:
    """A time to three digits, without an exponent."""
    return f"{value:.0f}" if value >= 100.0 else f"{value:.3g}"


def comparison(rows: Sequence[Row]) -> list[str]:
    """For each case and size the fastest setting of each method whose error is at most COMPARED_AT, as a list."""
    said = []
    for case, size in dict.fromkeys((r.case, r.size) for r in rows):
        words = []
        for method in dict.fromkeys(r.method for r in rows):
            tried = [r for r in rows if (r.case, r.size, r.method) == (case, size, method)]
            enough = [r.median_ms for r in tried if r.error <= COMPARED_AT]
            if enough:
                words.append(f"{method} {ms(min(enough))} ms")
            else:
                best = min(tried, key=lambda r: r.error)
                words.append(f"{method} none (best error {best.error:.1e} in {ms(best.median_ms)} ms)")
        said.append(f"* {case}, {size} nodes: {'; '.join(words)}.")
    return said


def chart(rows: Sequence[Row]) -> str:
    """Error over time, both logarithmic, a panel for each case; colour tells the method, a dash the smaller mesh."""
    cases = list(dict.fromkeys(r.case for r in rows))
    decades = [_decades([r.median_ms for r in rows]), _decades([r.error for r in rows])]
    panels = [
        _panel(k % 2 * WIDTH, k // 2 * HEIGHT, case, [r for r in rows if r.case == case], *decades)
        for k, case in enumerate(cases)
    ]
    width, height = 2.0 * WIDTH, math.ceil(len(cases) / 2) * HEIGHT
    return drawing(
        width,
        height,
        element("rect", x=0.0, y=0.0, width=width, height=height, fill=PAPER),
        element("g", *(p for panel in panels for p in panel), font_family="sans-serif", font_size=11.0, fill=INK),
        label="Error over time for the paper's relaxation and the kept factor",
    )


def _decades(values: Sequence[float]) -> tuple[int, int]:
    logs = [math.log10(v) for v in values if v > 0.0]
    low, high = math.floor(min(logs)), math.ceil(max(logs))
    return low, max(high, low + 1)


def _panel(x0: float, y0: float, case: str, rows: list[Row], across: tuple[int, int], up: tuple[int, int]) -> list[str]:
    left, right, top, bottom = x0 + LEFT, x0 + WIDTH - RIGHT, y0 + TOP, y0 + HEIGHT - BOTTOM

    def x(took: float) -> float:
        return left + (math.log10(took) - across[0]) / (across[1] - across[0]) * (right - left)

    def y(error: float) -> float:
        return bottom - (math.log10(error) - up[0]) / (up[1] - up[0]) * (bottom - top)

    parts = [text(left, top - 14.0, case, font_weight="bold")]
    for k in range(across[0], across[1] + 1):
        parts.append(line(x(10.0**k), top, x(10.0**k), bottom, stroke=LINE))
        parts.append(text(x(10.0**k), bottom + 15.0, f"{10.0**k:g}", text_anchor="middle"))
    for k in range(up[0], up[1] + 1):
        parts.append(line(left, y(10.0**k), right, y(10.0**k), stroke=LINE))
        parts.append(text(left - 6.0, y(10.0**k) + 4.0, f"{10.0**k:g}", text_anchor="end"))
    parts.append(text(x0 + 8.0, top - 14.0, "error / R", fill=GREY))
    sizes = sorted({r.size for r in rows})
    below = f"ms a frame (dashed: {sizes[0]} nodes, solid: {sizes[-1]})" if len(sizes) > 1 else "ms a frame"
    parts.append(text(0.5 * (left + right), bottom + 34.0, below, text_anchor="middle", fill=GREY))
    for method, colour in (("relaxation", VERMILLION), ("kept factor", BLUE)):
        for size in sizes:
            points = [(x(r.median_ms), y(r.error)) for r in rows if (r.method, r.size) == (method, size)]
            dash = "4 3" if size == sizes[0] and len(sizes) > 1 else "none"
            parts.append(polyline(points, stroke=colour, stroke_width=2.0, stroke_dasharray=dash))
            parts += [element("circle", cx=px, cy=py, r=3.0, fill=colour) for px, py in points]
    parts.append(text(right - 70.0, top - 14.0, "relaxation", fill=VERMILLION, text_anchor="end"))
    parts.append(text(right, top - 14.0, "kept factor", fill=BLUE, text_anchor="end"))
    return parts
