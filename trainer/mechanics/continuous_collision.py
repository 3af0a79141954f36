"""When moving bodies meet within a tick: a point and a triangle, two segments, a segment and a triangle.

All nodes move in straight lines at constant speed from the tick's start to its end, time 0 to 1. Two questions:

*When do they first come within a thickness?* Conservative advancement (Mirtich 1996, "Impulse-based dynamic simulation
of rigid body systems", 3.2; for linear motions Li et al. 2021, "Codimensional incremental potential contact", 5): while
no two points of the bodies approach faster than L, nothing within the thickness happens before gap / L, so time goes on
by that, less half of ``TOUCH_MM``. It stops at a gap of ``TOUCH_MM``, or after ``MOST_STEPS``, at the smallest gap:
since these steps together are less than a tick, that gap is below L / ``MOST_STEPS`` + ``TOUCH_MM``. So no contact is
missed, whatever the shapes, and a reported one came at least that near.

*When does a point go through a triangle, or an edge through an edge?* The zeros of the volume
(:mod:`trainer.mechanics.coplanarity`), exact to rounding, where the bodies are in touch at that time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from trainer.geometry import Array
from trainer.mechanics.closest_points import point_triangle, segment_segment
from trainer.mechanics.coplanarity import coplanar_times, volume_at, volume_coefficients
from trainer.mechanics.pair_list import checked_elements, checked_margin, largest_magnitude

#: Bodies this near each other touch, mm: assumed, a nanometre, a thousand roundings of a coordinate of a metre.
TOUCH_MM = 1e-6
#: Steps of an advancement. A straight approach takes one, one at 2 degrees from 20 mm 480.
MOST_STEPS = 4096
#: What four points are: a point and a triangle, or two segments.
POINT_TRIANGLE, EDGE_EDGE = 0, 1


@njit(cache=True, nogil=True, error_model="numpy")
def _place(start, end, t, now):  # type: ignore[no-untyped-def]
    s = 1.0 - t
    for k in range(4):
        for d in range(3):
            now[k, d] = s * start[k, d] + t * end[k, d]


@njit(cache=True, nogil=True, error_model="numpy")
def _nearest(kind, now):  # type: ignore[no-untyped-def]
    """Squared distance and two weights: of points 2 and 3 of the triangle, or of points 1 and 3 of the segments."""
    if kind == POINT_TRIANGLE:
        return point_triangle(now[0, 0], now[0, 1], now[0, 2], now, 1, 2, 3)
    return segment_segment(now, 0, 1, now, 2, 3)


@njit(cache=True, nogil=True, error_model="numpy")
def _separation(kind, x, u, v, d):  # type: ignore[no-untyped-def]
    """Coordinate d of the way from the second body's point with the weights to the first body's."""
    if kind == POINT_TRIANGLE:
        return x[0, d] - ((1.0 - u - v) * x[1, d] + u * x[2, d] + v * x[3, d])
    return (1.0 - u) * x[0, d] + u * x[1, d] - ((1.0 - v) * x[2, d] + v * x[3, d])


@njit(cache=True, nogil=True, error_model="numpy")
def _fastest(kind, start, end):  # type: ignore[no-untyped-def]
    """A bound on the relative way of any point of one body against any of the other: that of two corners."""
    largest = 0.0
    ones = 1 if kind == POINT_TRIANGLE else 2
    for i in range(ones):
        for j in range(ones, 4):
            squared = 0.0
            for d in range(3):
                squared += ((end[i, d] - start[i, d]) - (end[j, d] - start[j, d])) ** 2
            largest = squared if squared > largest else largest
    return math.sqrt(largest)


@njit(cache=True, nogil=True, error_model="numpy")
def _normal(kind, start, end, now, u, v, normal):  # type: ignore[no-untyped-def]
    """The unit normal from the second body to the first: along what separates them, or of their common plane."""
    for d in range(3):
        normal[d] = _separation(kind, now, u, v, d)
    size = math.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
    if size < 1e-3 * TOUCH_MM:
        # In touch but for rounding: the plane of both, seen from where the first body came, or was going less.
        b, c, e, f = (1, 2, 1, 3) if kind == POINT_TRIANGLE else (0, 1, 2, 3)
        for d in range(3):
            g, h = (d + 1) % 3, (d + 2) % 3
            normal[d] = (now[c, g] - now[b, g]) * (now[f, h] - now[e, h])
            normal[d] -= (now[c, h] - now[b, h]) * (now[f, g] - now[e, g])
        size = math.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
        before = after = 0.0
        for d in range(3):
            before += normal[d] * _separation(kind, start, u, v, d)
            after += normal[d] * _separation(kind, end, u, v, d)
        if before < after:
            size = -size
    if size == 0.0:  # no plane: against the relative motion
        for d in range(3):
            normal[d] = _separation(kind, start, u, v, d) - _separation(kind, end, u, v, d)
        size = math.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
    if size == 0.0:
        normal[2] = size = 1.0
    for d in range(3):
        normal[d] /= size


@njit(cache=True, nogil=True, error_model="numpy")
def contact(kind, start, end, thickness, until, now, normal):  # type: ignore[no-untyped-def]
    """The first time up to ``until`` at which the bodies are within ``thickness``: (time, u, v), time inf for never.

    ``start`` and ``end`` (4, 3) are the four points; ``now`` (4, 3) is scratch; ``normal`` (3,) is written when they
    meet. Weights u, v as in :func:`_nearest`.
    """
    fastest = _fastest(kind, start, end)
    t, smallest, time, u, v = 0.0, np.inf, np.inf, 0.0, 0.0
    for _ in range(MOST_STEPS):
        _place(start, end, t, now)
        squared, a, b = _nearest(kind, now)
        gap = math.sqrt(squared) - thickness
        if gap < smallest:
            smallest, time, u, v = gap, t, a, b
        if gap <= TOUCH_MM:
            break
        t += (gap - 0.5 * TOUCH_MM) / fastest  # not quite there: what separates them gives the normal
        if not t <= until:
            return np.inf, 0.0, 0.0
    _place(start, end, time, now)
    _normal(kind, start, end, now, u, v, normal)
    return time, u, v


@njit(cache=True, nogil=True, error_model="numpy")
def crossing(kind, start, end, now, normal, times):  # type: ignore[no-untyped-def]
    """The first time at which the point is on the triangle, or the edges on each other: (time, u, v, side).

    Time is inf for never. ``side`` is 1 for a point that comes from the side of the triangle's normal (right-hand
    rule), -1 from the other, 0 where it began in the plane; for edges it tells both senses apart. ``now`` (4, 3) and
    ``times`` (7,) are scratch; ``normal`` (3,) is written.
    """
    b0, b1, b2, b3, rounding = volume_coefficients(start, end)
    if max(max(abs(b0), abs(b1)), max(abs(b2), abs(b3))) <= rounding:
        t, u, v = contact(kind, start, end, 0.0, 1.0, now, normal)
        return t, u, v, 0
    count = coplanar_times(b0, b1, b2, b3, rounding, times)
    for k in range(count):
        t = times[k]
        _place(start, end, t, now)
        squared, u, v = _nearest(kind, now)
        if squared <= TOUCH_MM * TOUCH_MM:
            _normal(kind, start, end, now, u, v, normal)
            before = volume_at(0.5 * (t + (times[k - 1] if k > 0 else 0.0)), b0, b1, b2, b3)
            return t, u, v, (0 if abs(before) <= rounding else (-1 if before > 0.0 else 1))
    return np.inf, 0.0, 0.0, 0


@njit(cache=True, nogil=True, error_model="numpy")
def _take(points, at, x, row):  # type: ignore[no-untyped-def]
    for d in range(3):
        points[at, d] = x[row, d]


@njit(cache=True, nogil=True, error_model="numpy")
def _segments_triangles(  # type: ignore[no-untyped-def]
    pairs, count, p0, p1, segments, x0, x1, triangles, thickness, four, time, on_segment, on_triangle, normal
):
    start, end, now = four[0], four[1], four[2]
    way = four[3, 0]
    for k in range(count):
        s, f = pairs[k, 0], pairs[k, 1]
        time[k] = np.inf
        until = 1.0
        for feature in range(5):
            if feature < 2:  # an end of the segment and the triangle
                kind = POINT_TRIANGLE
                _take(start, 0, p0, segments[s, feature])
                _take(end, 0, p1, segments[s, feature])
                for c in range(3):
                    _take(start, 1 + c, x0, triangles[f, c])
                    _take(end, 1 + c, x1, triangles[f, c])
            else:  # the segment and an edge
                kind = EDGE_EDGE
                first, second = feature - 2, (feature - 1) % 3
                for c in range(2):
                    _take(start, c, p0, segments[s, c])
                    _take(end, c, p1, segments[s, c])
                _take(start, 2, x0, triangles[f, first])
                _take(end, 2, x1, triangles[f, first])
                _take(start, 3, x0, triangles[f, second])
                _take(end, 3, x1, triangles[f, second])
            t, u, v = contact(kind, start, end, thickness, until, now, way)
            if t >= time[k]:
                continue
            time[k] = until = t
            for d in range(3):
                normal[k, d] = way[d]
                on_triangle[k, d] = 0.0
            if feature < 2:
                on_segment[k] = float(feature)
                on_triangle[k, 0], on_triangle[k, 1], on_triangle[k, 2] = 1.0 - u - v, u, v
            else:
                on_segment[k] = u
                on_triangle[k, first], on_triangle[k, second] = 1.0 - v, v


@njit(cache=True, nogil=True, error_model="numpy")
def _segments_segments(  # type: ignore[no-untyped-def]
    pairs, count, p0, p1, segments, x0, x1, others, thickness, four, time, on_first, on_second, normal
):
    start, end, now = four[0], four[1], four[2]
    for k in range(count):
        for c in range(2):
            _take(start, c, p0, segments[pairs[k, 0], c])
            _take(end, c, p1, segments[pairs[k, 0], c])
            _take(start, 2 + c, x0, others[pairs[k, 1], c])
            _take(end, 2 + c, x1, others[pairs[k, 1], c])
        t, u, v = contact(EDGE_EDGE, start, end, thickness, 1.0, now, normal[k])
        time[k], on_first[k], on_second[k, 0], on_second[k, 1] = t, u, 1.0 - v, v


@dataclass(frozen=True)
class Impacts:
    """The first contact of each pair within a tick; rows whose time is inf never meet and hold nothing else.

    Views that the next call overwrites.
    """

    time: Array  # (k,) 0..1, inf for never
    first: Array  # (k,) weight of the segment's second node
    second: Array  # (k, 3) weights of the triangle's corners; of the other segment's nodes in the first two columns
    normal: Array  # (k, 3) unit vector from the second body to the first


class SweptContact:
    """First contacts of ``segments`` (m, 2) with ``elements``: triangles (f, 3), or segments (f, 2).

    For candidate pairs from :mod:`trainer.mechanics.cells` or :mod:`trainer.mechanics.self_contact`. Arrays grow when
    there are more pairs than ever before.
    """

    def __init__(self, segments: np.ndarray, elements: np.ndarray) -> None:
        self._segments = checked_elements(segments, 2, "segments")
        corners = 2 if elements.ndim == 2 and elements.shape[1] == 2 else 3
        self._elements = checked_elements(elements, corners, "elements")
        self._kernel = _segments_segments if corners == 2 else _segments_triangles
        self._four = np.zeros((4, 4, 3))
        self._make_room(256)

    def _make_room(self, room: int) -> None:
        self._time = np.zeros(room)
        self._first = np.zeros(room)
        self._second = np.zeros((room, 3))
        self._normal = np.zeros((room, 3))

    def impacts(self, pairs: np.ndarray, p0: Array, p1: Array, x0: Array, x1: Array, thickness_mm: float) -> Impacts:
        """When the ``pairs`` (k, 2) int32 first come within ``thickness_mm`` while p0 → p1 and x0 → x1 (n, 3) mm.

        Bodies that are within it at the start meet at time 0. A segment that is through a triangle from the start, none
        of its ends or the triangle's edges near, is held by no contact and meets when one of these comes near. Raises
        ValueError for places that are NaN, infinite or beyond 1e9 mm.
        """
        thickness = checked_margin(thickness_mm)
        for x, name in ((p0, "segments"), (p1, "segments"), (x0, "elements"), (x1, "elements")):
            largest_magnitude(x, name)
        count = len(pairs)
        if count:
            self._check(pairs, p0, p1, x0, x1)
        if count > len(self._time):
            self._make_room(count + count // 2)
        self._kernel(
            pairs, count, p0, p1, self._segments, x0, x1, self._elements, thickness, self._four,
            self._time, self._first, self._second, self._normal,
        )  # fmt: skip
        return Impacts(self._time[:count], self._first[:count], self._second[:count], self._normal[:count])

    def _check(self, pairs: np.ndarray, p0: Array, p1: Array, x0: Array, x1: Array) -> None:
        for column, (elements, now, then) in enumerate(((self._segments, p0, p1), (self._elements, x0, x1))):
            if pairs[:, column].min() < 0 or pairs[:, column].max() >= len(elements):
                raise ValueError(f"pairs: column {column} names none of the {len(elements)} elements")
            if elements.max() >= min(len(now), len(then)):
                raise ValueError(f"an element names node {elements.max()}, found {min(len(now), len(then))} nodes")
