"""The curved needle: a circular arc in its own frame, with closed forms for its points.

Frame of the needle: the tip at the origin, +x the direction in which the tip advances, the circle's centre
at +y r; the body lies behind the tip. Arc s, mm, runs from the tip (0) to the swage (``length``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from trainer.geometry import Array


@dataclass(frozen=True)
class Needle:
    """``radius`` mm of the circle, ``length`` mm along the arc: a 3/8 circle has length 2 pi radius 3/8.

    Raises ValueError unless both are positive and the arc is at most a full circle.
    """

    radius: float
    length: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.radius) and self.radius > 0.0):
            raise ValueError(f"a needle's radius cannot be {self.radius} mm: give more than 0")
        if not 0.0 < self.length <= 2.0 * math.pi * self.radius:
            raise ValueError(
                f"a needle of radius {self.radius} mm cannot be {self.length} mm long: give more than 0 and at most"
                f" {2.0 * math.pi * self.radius:.6g}, a full circle"
            )


def needle_point(needle: Needle, s: float) -> Array:
    """The point (3,) mm at arc ``s``: (-r sin(s/r), r (1 - cos(s/r)), 0)."""
    half = 0.5 * s / needle.radius
    # 1 - cos a = 2 sin(a/2)^2 keeps its digits near the tip
    return np.array([-needle.radius * math.sin(2.0 * half), 2.0 * needle.radius * math.sin(half) ** 2, 0.0])


def needle_tangent(needle: Needle, s: float) -> Array:
    """The unit tangent (3,) at arc ``s``, pointing towards the tip."""
    angle = s / needle.radius
    return np.array([math.cos(angle), -math.sin(angle), 0.0])


def needle_closest(needle: Needle, point: Array) -> tuple[float, float]:
    """(distance mm, arc s mm) of the needle's point nearest to ``point`` (3,) in the needle's frame.

    The nearest point of the circle if it lies on the arc, else the nearer end. On the circle's axis all
    points are equally near and the tip is answered.
    """
    x, y, z = float(point[0]), float(point[1]) - needle.radius, float(point[2])
    s = math.atan2(-x, -y) % (2.0 * math.pi) * needle.radius
    if x == 0.0 and y == 0.0:
        s = 0.0
    if s <= needle.length:
        return math.hypot(math.hypot(x, y) - needle.radius, z), s
    return min((math.dist(needle_point(needle, end), point), end) for end in (0.0, needle.length))
