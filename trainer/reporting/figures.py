"""The figures of the reports: target strip, stitch map, angle histogram, learning curve."""

from __future__ import annotations

import itertools
import math

from trainer.reporting import wording
from trainer.reporting.progress import Curve
from trainer.reporting.session import BIN_DEG, Bite, Histogram, MetricRow, StitchMap
from trainer.reporting.svg import (
    BAND,
    BAND_EDGE,
    BLUE,
    GREY,
    INK,
    LINE,
    PAPER,
    VERMILLION,
    drawing,
    element,
    is_dark,
    line,
    mix,
    polyline,
    text,
    ticks,
)

#: Colours of an entry-angle error of 0, 20 and 45 degrees and more: dark blue, pale, dark orange.
_ERROR_COLOURS = ((0.0, BLUE), (20.0, "#f0e2bd"), (45.0, "#b34700"))


def error_colour(error_deg: float | None) -> str:
    """The colour of an angle error; grey where none was measured."""
    if error_deg is None:
        return LINE
    for (low, dark), (high, light) in itertools.pairwise(_ERROR_COLOURS):
        if error_deg <= high:
            return mix(dark, light, max(error_deg - low, 0.0) / (high - low))
    return _ERROR_COLOURS[-1][1]


def strip(row: MetricRow, earlier: tuple[float, ...] = ()) -> str:
    """The value on a scale with its target band; earlier values are small and grey."""
    width, height, pad = 132.0, 22.0, 7.0
    limits = [v for v in (row.target_low, row.target_high) if v is not None]
    seen = [v for v in (row.value, *earlier) if v is not None]
    top = 90.0 if row.unit == "deg" else ticks(0.0, max(1.25 * max([*limits, *seen], default=1.0), 1e-9), 4)[-1]
    if row.unit in ("count", "ratio"):
        top = max(top, 1.0)
    low = min(0.0, *limits, *seen) if limits or seen else 0.0

    def x(value: float) -> float:
        return pad + (width - 2 * pad) * (min(max(value, low), top) - low) / (top - low)

    middle = 0.5 * height
    left = x(low if row.target_low is None else row.target_low)
    right = x(top if row.target_high is None else row.target_high)
    parts = [
        line(pad, middle, width - pad, middle, stroke=LINE, stroke_width=1),
        element("rect", x=left - 2, y=middle - 6, width=right - left + 4, height=12, rx=2, fill=BAND, stroke=BAND_EDGE,
                stroke_width=0.6),
    ]  # fmt: skip
    parts += [element("circle", cx=x(v), cy=middle, r=2, fill="none", stroke=GREY, stroke_width=0.9) for v in earlier]
    if row.value is not None:
        at = x(row.value)
        if row.met:
            parts.append(element("circle", cx=at, cy=middle, r=4.2, fill=INK))
        else:
            points = f"{at:.2f},{middle - 5.2:.2f} {at + 5.2:.2f},{middle:.2f} {at:.2f},{middle + 5.2:.2f} "
            parts.append(element("polygon", points=points + f"{at - 5.2:.2f},{middle:.2f}", fill=VERMILLION))
    said = f"{row.title}: {wording.quantity(row.value, row.unit)}"
    return drawing(width, height, *parts, label=f"{said}, target {wording.band(row.target_low, row.target_high, '')}")


def stitch_map(shown: StitchMap) -> str:
    """Looking at each cut edge, unrolled outwards: angle is the clock, distance from the inner circle the bite."""
    size, edge, rim = 206.0, 32.0, 82.0
    width, height = max(size * len(shown.vessels), 300.0), 246.0  # the legend is 300 wide
    farthest = max([0.5, *(b.bite_mm for b in shown.bites), *(m.bite_mm for m in shown.marks)])
    rings = ticks(0.0, farthest, 3)
    left = 0.5 * (width - size * len(shown.vessels))
    centres = {v: (left + size * (i + 0.5), 106.0) for i, v in enumerate(shown.vessels)}

    def place(vessel: str, clock_deg: float, bite_mm: float) -> tuple[float, float]:
        radius = edge + (rim - edge) * max(bite_mm, 0.0) / rings[-1]
        angle = math.radians(clock_deg)
        cx, cy = centres[vessel]
        return cx + radius * math.sin(angle), cy - radius * math.cos(angle)

    parts = [_face(v, c, edge, rim, rings) for v, c in centres.items()]
    for a, b in shown.stitches:
        (x1, y1), (x2, y2) = place(a.vessel, a.clock_deg, a.bite_mm), place(b.vessel, b.clock_deg, b.bite_mm)
        parts.append(line(x1, y1, x2, y2, stroke=INK, stroke_width=1.1, stroke_opacity=0.55))
    for m in shown.marks:
        x, y = place(m.vessel, m.clock_deg, m.bite_mm)
        parts.append(element("circle", cx=x, cy=y, r=10, fill="none", stroke=INK, stroke_width=1.1,
                             stroke_dasharray="2.5 2"))  # fmt: skip
    parts += [_dot(b, *place(b.vessel, b.clock_deg, b.bite_mm)) for b in shown.bites]
    parts.append(_error_legend(0.5 * width, height - 24.0))
    return drawing(width, height, *parts, label="Stitch map: clock angle and bite of each hole")


def _face(vessel: str, centre: tuple[float, float], edge: float, rim: float, rings: list[float]) -> str:
    cx, cy = centre
    parts = [element("circle", cx=cx, cy=cy, r=rim, fill="#f6f7f9", stroke=LINE, stroke_width=0.8)]
    for ring in rings[1:-1]:
        radius = edge + (rim - edge) * ring / rings[-1]
        parts.append(element("circle", cx=cx, cy=cy, r=radius, fill="none", stroke=LINE, stroke_width=0.7))
    for hour in range(12):
        s, c = math.sin(math.radians(30 * hour)), math.cos(math.radians(30 * hour))
        parts.append(line(cx + rim * s, cy - rim * c, cx + (rim + 4) * s, cy - (rim + 4) * c, stroke=GREY,
                          stroke_width=0.8))  # fmt: skip
        if hour % 3 == 0:
            parts.append(text(cx + (rim + 12) * s, cy - (rim + 12) * c + 3.2, str(hour or 12), font_size=9.5,
                              fill=GREY, text_anchor="middle"))  # fmt: skip
    for ring in rings[1:]:  # along 7:30, where few stitches lie
        radius = (edge + (rim - edge) * ring / rings[-1]) * math.sqrt(0.5)
        parts.append(text(cx - radius, cy + radius, f"{ring:g}", font_size=8, fill=GREY, text_anchor="middle",
                          paint_order="stroke", stroke="#f6f7f9", stroke_width=3))  # fmt: skip
    parts.append(element("circle", cx=cx, cy=cy, r=edge, fill=PAPER, stroke=INK, stroke_width=1.6))
    parts.append(text(cx, cy + 1, vessel, font_size=17, font_weight=600, fill=INK, text_anchor="middle"))
    parts.append(text(cx, cy + 13, "cut edge", font_size=7.5, fill=GREY, text_anchor="middle"))
    return "".join(parts)


def _dot(bite: Bite, x: float, y: float) -> str:
    """A filled dot where thread or needle stays, a ringed one where it has been left again."""
    fill = error_colour(bite.angle_error_deg)
    words = PAPER if is_dark(fill) else INK
    said = "–" if bite.angle_error_deg is None else f"{bite.angle_error_deg:.0f}° from upright"
    hint = f"pass {bite.pass_number}: {wording.clock(bite.clock_deg)}, {bite.bite_mm:.2f} mm, {said}"
    look = {} if bite.kept else {"stroke_dasharray": "1.5 1.5"}
    return element(
        "g",
        element("title", hint),
        element("circle", cx=x, cy=y, r=6.4, fill=fill, stroke=INK, stroke_width=0.9, **look),
        text(x, y + 2.9, str(bite.pass_number), font_size=8, fill=words, text_anchor="middle"),
    )


def _error_legend(x: float, y: float) -> str:
    width, steps = 120.0, 45
    left = x - 0.5 * width
    cells = [
        element("rect", x=left + width * i / steps, y=y, width=width / steps + 0.3, height=6, fill=error_colour(i))
        for i in range(steps)
    ]
    marks = [
        text(left + width * at / 45.0, y + 16, label, font_size=8, fill=GREY, text_anchor="middle")
        for at, label in ((0, "0°"), (20, "20°"), (45, "45° +"))
    ]
    name = text(left - 8, y + 6, "from upright", font_size=8.5, fill=GREY, text_anchor="end")
    ring = element("circle", cx=left + width + 34, cy=y + 3, r=6, fill="none", stroke=INK, stroke_width=1,
                   stroke_dasharray="2.5 2")  # fmt: skip
    return "".join([*cells, *marks, name, ring, text(left + width + 46, y + 6, "mark", font_size=8.5, fill=GREY)])


def angle_histogram(shown: Histogram) -> str:
    """Entry angles from 0 to 90 degrees with the target band behind."""
    width, height, left, right, top, bottom = 246.0, 246.0, 24.0, 8.0, 20.0, 52.0
    most = max(shown.counts, default=0)
    scale = [s for s in ticks(0.0, max(most, 4), 4) if s == int(s)]

    def x(angle: float) -> float:
        return left + (width - left - right) * angle / 90.0

    def y(count: float) -> float:
        return height - bottom - (height - top - bottom) * count / scale[-1]

    parts = []
    if shown.target_low is not None or shown.target_high is not None:
        low, high = shown.target_low or 0.0, 90.0 if shown.target_high is None else shown.target_high
        parts.append(element("rect", x=x(low), y=top, width=x(high) - x(low), height=height - top - bottom, fill=BAND))
        parts.append(text(x(0.5 * (low + high)), top - 5, "target", font_size=8.5, fill=BAND_EDGE,
                          text_anchor="middle"))  # fmt: skip
    for s in scale:
        parts.append(line(left, y(s), width - right, y(s), stroke=LINE, stroke_width=0.6))
        parts.append(text(left - 6, y(s) + 3, f"{s:g}", font_size=9, fill=GREY, text_anchor="end"))
    for i, count in enumerate(shown.counts):
        if count:
            parts.append(element("rect", x=x(i * BIN_DEG) + 0.8, y=y(count), width=x(BIN_DEG) - x(0) - 1.6,
                                 height=y(0) - y(count), fill=BLUE))  # fmt: skip
    parts.append(line(left, y(0), width - right, y(0), stroke=INK, stroke_width=1))
    for angle in range(0, 91, 15):
        parts.append(line(x(angle), y(0), x(angle), y(0) + 3, stroke=INK, stroke_width=0.8))
        parts.append(text(x(angle), y(0) + 13, f"{angle}°", font_size=9, fill=GREY, text_anchor="middle"))
    parts.append(text(0.5 * (left + width), height - 22, "angle to the wall at entry (90° is upright)", font_size=9,
                      fill=GREY, text_anchor="middle"))  # fmt: skip
    return drawing(width, height, *parts, label="Histogram of the entry angles")


def learning_curve(curve: Curve, attempts: int) -> str:
    """A value over attempts: each attempt, the median of the last three, and Theil and Sen's line."""
    width, height, left, right, top, bottom = 320.0, 190.0, 34.0, 8.0, 12.0, 38.0
    scale = ticks(0.0, max([4.0 if curve.unit == "count" else 1e-9, *curve.values]), 4)
    last = max(attempts, 5)

    def x(attempt: float) -> float:
        return left + (width - left - right) * (attempt - 0.5) / last

    def y(value: float) -> float:
        return height - bottom - (height - top - bottom) * value / scale[-1]

    parts = []
    for s in scale:
        parts.append(line(left, y(s), width - right, y(s), stroke=LINE, stroke_width=0.6))
        parts.append(text(left - 6, y(s) + 3, f"{s:g}", font_size=9, fill=GREY, text_anchor="end"))
    every = max(1, math.ceil(last / 12))
    for n in range(1, last + 1, every):
        parts.append(text(x(n), height - bottom + 13, str(n), font_size=9, fill=GREY, text_anchor="middle"))
    parts.append(line(left, y(0), width - right, y(0), stroke=INK, stroke_width=1))
    if curve.trend is not None:
        ends = [(n, curve.trend.intercept + curve.trend.slope * n) for n in (curve.attempts[0], curve.attempts[-1])]
        parts.append(polyline([(x(n), y(min(max(v, 0.0), scale[-1]))) for n, v in ends], stroke=GREY,
                              stroke_width=1.2, stroke_dasharray="5 3"))  # fmt: skip
    points = [(x(n), y(v)) for n, v in zip(curve.attempts, curve.values, strict=True)]
    parts.append(polyline(points, stroke=BLUE, stroke_width=1, stroke_opacity=0.45))
    if curve.recent is not None and len(curve.values) > 1:
        a, b = x(curve.attempts[-3:][0] - 0.4), x(curve.attempts[-1] + 0.4)
        parts.append(line(a, y(curve.recent), b, y(curve.recent), stroke=VERMILLION, stroke_width=2.4))
    parts += [element("circle", cx=px, cy=py, r=3.4, fill=BLUE, stroke=PAPER, stroke_width=0.8) for px, py in points]
    parts.append(text(0.5 * (left + width), height - 8, "attempt", font_size=9, fill=GREY, text_anchor="middle"))
    return drawing(width, height, *parts, label=f"{curve.title} over attempts")
